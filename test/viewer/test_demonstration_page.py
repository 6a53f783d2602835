"""The page on which a person demonstrates."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from fake_browser import CAMERA, PORT
from waiting import wait_until

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.learning.by_person import View
from endo_sim_ros.learning.person_config import PersonConfig
from endo_sim_ros.viewer.browser import Pointer
from endo_sim_ros.viewer.config import ViewerConfig

IMAGE = np.tile(np.linspace(40, 255, CAMERA.width, dtype=np.uint8)[None, :, None], (CAMERA.height, 1, 3))
VIEW = View(IMAGE, CAMERA, 0.05, ("Do it.", "move to begin"))


@pytest.fixture
def page():
    pytest.importorskip("viser")
    from endo_sim_ros.viewer.demonstration_page import DemonstrationPage

    page = DemonstrationPage(PersonConfig(port=PORT + 11))
    yield page
    page.stop()


def test_the_tip_goes_as_far_as_the_mouse_a_step_at_a_time(page):
    pictures = []
    camera = SimpleNamespace(image_width=400, image_height=160)  # wider than the picture, whose height it shows
    scene = SimpleNamespace(set_background_image=lambda image, *_, **options: pictures.append(image))
    page.browsers[1] = SimpleNamespace(camera=camera, scene=scene)
    page.show(VIEW)
    page.show(VIEW)
    assert len(pictures) == 1 and pictures[0].shape == (160, 400, 3), "what has not changed is not sent again"
    for phase, at in (("start", (0.5, 0.5)), ("update", (0.55, 0.5)), ("end", (0.6, 0.25))):
        page.point(Pointer(1, phase, (0.5, 0.5), at, False))
    ways = np.array([page.read().way for _ in range(4)])
    np.testing.assert_allclose(ways.sum(0), [0.1 * 400 * 0.05, 0.25 * 160 * 0.05, 0], atol=1e-9)
    np.testing.assert_allclose(ways[[0, 3]], [[1, 1, 0], [0, 0, 0]], atol=1e-9)
    page.point(Pointer(1, "start", (0.5, 0.5), (0.5, 0.45), True))
    np.testing.assert_allclose(page.read().way, [0, 0, 0.05 * 160 * 0.05], atol=1e-9)


@pytest.mark.dds
def test_an_address_that_nothing_can_be_served_at_is_refused(page):
    from endo_sim_ros.viewer.viewer import serve

    with pytest.raises(ConfigError, match=r"cannot be served at 203\.0\.113\.9:\d+ \(.*\); give another host or port"):
        serve(ViewerConfig(host="203.0.113.9", port=PORT + 12))  # nobody has this address (RFC 5737)
    other = serve(ViewerConfig(port=PORT + 11))
    assert other.get_port() > PORT + 11, "the next free port"
    other.stop()


@pytest.mark.dds
def test_in_a_browser_the_picture_is_seen_dragged_and_keys_are_heard(chromium, page):
    wishes, going = [], threading.Event()
    going.set()

    def drive():
        while going.is_set():
            page.show(VIEW)
            page.wait(time.monotonic() + 0.02)
            wishes.append(page.read())

    thread = threading.Thread(target=drive)
    thread.start()
    try:
        tab = chromium.new_page(viewport={"width": 934, "height": 400})
        tab.goto(page.url)
        wait_until(lambda: page.browsers, 30, "the browser to come")
        tab.get_by_text("move to begin").wait_for()
        tab.wait_for_timeout(1000)
        tab.mouse.move(300, 200)
        tab.mouse.down()
        tab.mouse.move(350, 200, steps=5)
        tab.mouse.up()
        way = lambda: sum(wish.way for wish in wishes)
        wait_until(lambda: way()[0] > 1, 20, "the drag", lambda: tab.wait_for_timeout(50))
        assert abs(way()[1]) < 0.1 and way()[2] == 0
        for key in ("Space", "w", "r"):
            tab.keyboard.press(key)
        wait_until(lambda: any(wish.word == "again" for wish in wishes), 20, "the key", lambda: tab.wait_for_timeout(50))
        assert way()[2] == 1 and sum(wish.jaw for wish in wishes) == 1
    finally:
        going.clear()
        thread.join()
