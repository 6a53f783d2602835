"""The page in a real browser, and the command that serves it."""

import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_browser import CAMERA, PORT, SOFT, moved
from ros_bench import sheet
from waiting import wait_until

from endo_sim_ros.core.cameras import Camera, save_cameras
from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.viewer.config import ViewerConfig

pytestmark = pytest.mark.dds


def seen(tab):
    """Pixels of the tissue, beside panel and notifications; coarse, as the page draws fewer pixels on slow machines."""
    picture = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)[200:380, 150:320]
    return cv2.resize(picture, (17, 18), interpolation=cv2.INTER_AREA).astype(float)


def difference(a, b):
    return float(np.abs(a - b).mean())


def rows(tab):
    """Mean brightness [400] of the rows of the picture."""
    return cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)[:, :300].mean(1)


def frames_of(video):
    """Pictures of a video, in floating point."""
    capture, frames = cv2.VideoCapture(str(video)), []
    while (read := capture.read())[0]:
        frames.append(read[1].astype(float))
    return frames


def test_in_a_browser_tissue_is_seen_dragged_and_reset(chromium, tmp_path):
    pytest.importorskip("viser")
    from endo_sim_ros.viewer.standalone import Standalone

    camera = Camera(np.array([[330.0, 0, 330], [0, 330, 200], [0, 0, 1]]), 660, 400)
    config = ViewerConfig(port=PORT, max_force=20.0, videos=str(tmp_path))
    page = Standalone(sheet(tilt=0.3), [camera], SOFT, config)
    going = threading.Event()
    going.set()

    def drive():
        while going.is_set():
            page.turn()

    thread = threading.Thread(target=drive)
    thread.start()
    try:
        first, second = (chromium.new_page(viewport={"width": 934, "height": 400}) for _ in range(2))
        first.goto(page.viewer.url)
        second.goto(page.viewer.url)
        wait_until(lambda: seen(first).std() > 10, 30, "tissue on the page")
        first.wait_for_timeout(1000)  # the splats fade in
        rest = seen(first)
        wait_until(lambda: difference(seen(second), rest) < 2, 30, "the second browser to show the same")

        first.get_by_role("button", name="record video").click()
        first.get_by_role("button", name="stop video").wait_for()  # it records
        first.keyboard.down("Shift")
        first.mouse.move(200, 250)
        first.mouse.down()
        first.mouse.move(215, 250, steps=2)
        first.mouse.move(270, 220, steps=2)
        wait_until(lambda: moved(page) > 0.008, 20, "tissue to follow the mouse", lambda: first.wait_for_timeout(50))
        wait_until(lambda: difference(seen(first), rest) > 5, 20, "the picture to change")
        assert page.viewer.tools["mouse"].force[0] > 0
        first.mouse.up()
        first.keyboard.up("Shift")
        first.get_by_role("button", name="stop video").click()
        with first.expect_download() as download:
            first.get_by_role("link", name=".mp4").click()
        first.get_by_role("alert").filter(has_text=".mp4").get_by_role("button").last.click()  # it covers tissue
        (video,) = tmp_path.glob("*.mp4")
        assert Path(download.value.path()).read_bytes() == video.read_bytes()
        frames = frames_of(video)
        assert frames[0].std() > 5 and max(difference(frames[0], frame) for frame in frames) > 2, "tissue moves in the video"

        first.get_by_role("button", name="reset").click()
        wait_until(lambda: moved(page) == 0, 20, "tissue at rest", lambda: first.wait_for_timeout(50))
        wait_until(lambda: difference(seen(first), rest) < 1.5, 20, "the picture from before")

        first.mouse.move(200, 300)
        first.mouse.down()
        first.mouse.move(250, 300, steps=2)  # without Shift it turns the view of this browser only
        first.mouse.up()
        wait_until(lambda: difference(seen(first), rest) > 3, 20, "the view to turn")
        assert moved(page) == 0 and difference(seen(second), rest) < 2

        first.get_by_role("combobox", name="view").click()
        first.get_by_role("option", name="endoscope").click()
        wait_until(lambda: difference(seen(first), rest) < 10 and seen(first).std() > 10, 20, "the endoscope's picture")
        first.set_viewport_size({"width": 604, "height": 400})  # half the room beside the panel: the picture fits its width
        wait_until(lambda: rows(first)[310:].max() < 5 < rows(first)[150:250].min(), 20, "the endoscope's whole picture, smaller")
    finally:
        going.clear()
        thread.join()
        page.viewer.stop()


def test_view_command_serves_a_model(tmp_path):
    pytest.importorskip("viser")
    import subprocess
    import urllib.request

    save_ply(sheet(), tmp_path / "model.ply")
    save_cameras([CAMERA], tmp_path / "cameras.json")
    command = [sys.executable, "-u", "-m", "endo_sim_ros.cli", "view", tmp_path / "model.ply", "--node-count", 300, "--port", PORT + 7]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])
    try:
        line = next(line for line in process.stdout if line.startswith("open http"))
        with urllib.request.urlopen(line.split()[1], timeout=120) as answer:
            assert answer.status == 200 and b"<html" in answer.read().lower()
    finally:
        process.terminate()
        process.wait(120)
