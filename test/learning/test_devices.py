"""What a person acts with beside the page: bytes of gamepads and 3D mice, and hands in OpenXR."""

import fcntl
import importlib.util
import logging
import os
import shutil
import struct
import time

import numpy as np
import pytest
from remote_hands import Monado, RemoteHand
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.learning.devices.device_file import first_device, is_multi_axis_controller
from endo_sim_ros.learning.devices.gamepad import Gamepad, find_gamepad
from endo_sim_ros.learning.devices.hands import Grip, Hand
from endo_sim_ros.learning.devices.mouse_3d import Mouse3D, find_mouse_3d
from endo_sim_ros.learning.devices.openxr import find_hands
from endo_sim_ros.learning.person_config import GamepadConfig, HandConfig, OpenXRConfig, PushedConfig

# How the report descriptors of a SpaceMouse Wireless and of a gamepad begin.
MOUSE_3D = "05 01 09 08 A1 01 A1 00 85 01 16 A2 FE 26 5E 01 36 88 FA 46 78 05 55 0C 65 11 09 30 09 31 09 32 09 33 09 34 09 35 75 10"
GAMEPAD = "05 01 09 05 A1 01 85 01 09 30 09 31 09 32 09 35 15 00 26 FF 00 75 08 95 04 81 02"


@pytest.fixture
def pipe(tmp_path):
    """In the place of a device's file; what is written to it at once comes as one report, as from the kernel."""
    path = tmp_path / "device"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)
    fcntl.fcntl(writer, fcntl.F_SETFL, os.O_DIRECT)
    yield path, lambda data: os.write(writer, data), lambda: os.close(writer)


def test_sticks_and_buttons_of_a_gamepad_are_heard(pipe, tmp_path):
    path, write, end = pipe
    gamepad = Gamepad(path, GamepadConfig())

    def tell(*events):
        write(b"".join(struct.pack("=IhBB", 0, *event) for event in events))

    tell((0, 0x82, 0), (0, 0x82, 1), (1, 0x81, 0), (-32767, 0x82, 2))  # how it is at first: a button held, a trigger at rest
    wish = gamepad.read()
    assert not wish.jaw and not wish.way.any() and wish.word is None
    tell((32767, 2, 0), (16384, 2, 1), (-32767, 2, 4), (3000, 2, 3), (1, 1, 0), (0, 1, 0), (1, 1, 2))
    wish = gamepad.read()
    np.testing.assert_allclose(wish.way, [1, -(0.5 - 0.15) / 0.85, -1], atol=1e-3)
    assert wish.jaw and wish.turn == 0 and wish.word == "drop"
    tell((32767, 2, 3))
    again = gamepad.read()
    assert again.turn == -1, "to the right is clockwise"
    assert not again.jaw and again.word is None and (again.way == wish.way).all(), "sticks stay, buttons are pressed once"
    assert not again.gone
    end()
    wish = gamepad.read()
    assert wish.gone and not wish.way.any(), "without it nothing moves"
    assert find_gamepad(GamepadConfig(file="none")) is None
    with pytest.raises(ValueError, match=r"gamepad .*js7 cannot be opened \(No such file or directory\); allow it, name another, or none"):
        find_gamepad(GamepadConfig(file=str(tmp_path / "js7")))


def test_buttons_of_a_gamepad_are_options(pipe):
    path, write, end = pipe
    gamepad = Gamepad(path, GamepadConfig(button_finish=9, button_jaw=3, button_next=0))

    def pressed(*buttons):
        write(b"".join(struct.pack("=IhBB", 0, 1, 1, button) for button in buttons))
        wish = gamepad.read()
        return wish.jaw, wish.arm, wish.word

    assert pressed(9) == (False, False, "finish")
    assert pressed(7) == (False, False, None)
    assert pressed(3, 4) == (True, True, None) and pressed(0) == (False, False, "next")
    end()
    with pytest.raises(ConfigError, match="button_jaw and button_finish are both button 0; give each its own"):
        GamepadConfig(button_finish=0)
    with pytest.raises(ConfigError, match="stick_right and stick_near are both axis 0"):
        GamepadConfig(stick_near=0)


def test_the_tip_goes_as_the_cap_of_a_3d_mouse(pipe, caplog):
    path, write, end = pipe
    mouse = find_mouse_3d(PushedConfig(file=str(path), dead_zone=0.2))
    assert mouse is not None and not mouse.read().way.any()
    write(struct.pack("<B3h", 1, 100, 0, 0))
    write(struct.pack("<B3h", 1, 350, -210, -350))  # right, away from the user, up: the newest counts
    write(bytes.fromhex("02 00 00 e2 ff a2 fe"))  # twisted counter-clockwise, as seen from above
    wish = mouse.read()
    np.testing.assert_allclose([*wish.way, wish.turn], [1, 1, -0.5, 1], atol=1e-6)
    write(struct.pack("<B6h", 1, 0, 10, 280, 0, 0, 350))  # newer ones have one report; this turns clockwise
    wish = mouse.read()
    np.testing.assert_allclose([*wish.way, wish.turn], [0, -0.75, 0, -1], atol=1e-6)
    assert mouse.read().way[1] == pytest.approx(-0.75), "it stays until the next report"
    write(bytes.fromhex("17 64 01"))  # the battery
    end()
    assert not mouse.read().way.any() and f"3D mouse {path} is gone; the mouse and the keys go on" in caplog.text


def test_buttons_of_a_3d_mouse_are_jaw_arm_and_again(pipe):
    path, write, end = pipe
    mouse = Mouse3D(path, PushedConfig())

    def pressed(*held):
        for buttons in held:
            write(bytes([3, *buttons]))
        wish = mouse.read()
        return wish.jaw, wish.arm, wish.word

    assert pressed((1, 0)) == (True, False, None)
    assert pressed((1, 0)) == (False, False, None), "it is held"
    assert pressed((0, 0), (2, 0)) == (False, True, None)
    assert pressed((3, 0)) == (False, False, "again"), "one while the other is held"
    assert pressed((0, 0), (1, 0), (0, 0), (1, 0)) == (False, False, None), "closed, and opened again"
    assert pressed((0, 0x10, 0, 0)) == (False, False, None), "larger ones have more"
    end()


def test_axes_are_reversed_and_slowed_down(pipe):
    path, write, end = pipe
    options = {"reverse": ("near", "turn"), "speed": 0.5, "dead_zone": 0.0}
    mouse, pad = Mouse3D(path, PushedConfig(**options)), Gamepad(path, GamepadConfig(**options))
    write(struct.pack("<B6h", 1, 350, 350, -350, 0, 0, -350))
    wish = mouse.read()
    np.testing.assert_allclose([*wish.way, wish.turn], [0.5, 0.5, -0.5, -0.5])
    write(struct.pack("=IhBB", 0, 32767, 2, 4))
    np.testing.assert_allclose(pad.read().way, [0, 0, -0.5])
    end()


def test_3d_mice_are_known_by_what_they_say_of_themselves(tmp_path):
    for descriptor, known in ((MOUSE_3D, True), (GAMEPAD, False)):
        (tmp_path / "report_descriptor").write_bytes(bytes.fromhex(descriptor))
        assert is_multi_axis_controller(tmp_path) == known
    assert not is_multi_axis_controller(tmp_path / "nothing")


def test_the_first_device_that_can_be_opened_is_taken(pipe, tmp_path, caplog):
    path, _, end = pipe
    make = lambda file: Mouse3D(file, PushedConfig())
    found = first_device("", [tmp_path / "none", path], make)
    assert str(found) == f"3D mouse {path}" and "none cannot be opened" in caplog.text
    assert first_device("none", [path], make) is None and first_device("", [], make) is None
    end()


class Told:
    """Tells of a hand what stands in a list."""

    def __init__(self, *grips):
        self.grips = list(grips)

    def grip(self, hand):
        return self.grips.pop(0)

    def gone(self, hand):
        return False


def grip(place=(0, 0, 0), degrees=0.0, held=True, closed=False, pressed=()):
    return Grip(np.array(place), Rotation.from_euler("z", degrees, degrees=True), held, closed, frozenset(pressed))


def test_the_tip_follows_a_hand_that_holds_on():
    grips = [
        grip((0.5, 0, 0), held=False),
        grip((0.6, 0, 0)),
        grip((0.609, -0.003, 0.006), 10),
        grip((0.609, -0.003, 0.006), 10, closed=True),
    ]
    grips += [grip((0, 0, 0), 90, held=False, closed=True), None, grip((9, 9, 9)), grip((9, 9, 9.003), pressed=["next"]), None, None]
    hand = Hand(Told(*grips), 1, HandConfig(), Rotation.identity(), 1)
    wishes = [hand.read() for _ in grips]
    moves = [[*wish.way, wish.turn] for wish in wishes]
    expected = [[0] * 4, [0] * 4, [1, -0.5, 1, 1], [0.5, 0, 0, 1], *[[0] * 4] * 3, [0, 0, 0.5, 0], *[[0] * 4] * 2]
    np.testing.assert_allclose(moves, expected, atol=1e-9, err_msg="of a long way a step at a time, and nothing of where it went free")
    assert [wish.closed for wish in wishes] == [None, None, None, True, *[None] * 6]
    assert [wish.word for wish in wishes] == [*[None] * 7, "next", None, None] and all(wish.hand == 1 for wish in wishes)


def test_a_jaw_stays_as_it_was_where_the_grip_is_squeezed_again():
    """(held, closed) by time, and what the hand asks of the jaw."""
    told = [
        ((False, False), None), ((True, False), None), ((True, True), True), ((True, True), True),
        ((False, True), None), ((False, False), None), ((True, False), None), ((True, False), None),  # let go, and squeezed again
        ((True, True), True), ((True, False), False), ((True, False), None),
        ((False, True), None), ((True, True), None), ((True, True), None), ((True, False), False),  # pulled before it was squeezed
    ]  # fmt: skip
    hand = Hand(Told(*(grip(held=held, closed=closed) for (held, closed), _ in told)), 0, HandConfig(), Rotation.identity(), 0)
    assert [hand.read().closed for _ in told] == [asked for _, asked in told]


def test_a_hand_moves_as_the_person_sees_it():
    """Measured in a frame with x away from the person."""
    axes = Rotation.from_euler("y", -90, degrees=True)
    hand = Hand(Told(grip(), grip((0, 0, -0.006))), 0, HandConfig(), axes, 0)
    hand.read()
    np.testing.assert_allclose(hand.read().way, [1, 0, 0], atol=1e-9)


def test_a_still_hand_rests_whatever_the_noise_and_a_slow_one_moves():
    noise = 1e-4 * np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    hand = Hand(Told(*map(grip, noise), *(grip((2e-5 * step, 0, 0)) for step in range(301))), 0, HandConfig(), Rotation.identity(), 0)
    assert not any(hand.read().way.any() for _ in noise)
    assert sum(hand.read().way[0] for _ in range(301)) == pytest.approx(1, abs=0.05), "6 mm are a step"


def test_hands_without_a_runtime_are_told_where_they_are_asked_for(monkeypatch, tmp_path):
    monkeypatch.setenv("XR_RUNTIME_JSON", str(tmp_path / "none.json"))
    assert find_hands(OpenXRConfig()) == () == find_hands(OpenXRConfig(use="off"))
    wrong = "pyopenxr cannot be used .*pip install" if importlib.util.find_spec("xr") is None else "no runtime can be used .*start one"
    with pytest.raises(ValueError, match=f"openxr: {wrong}"):
        find_hands(OpenXRConfig(use="on"))


@pytest.mark.dds
def test_hands_are_heard_through_a_runtime_until_it_is_gone(monkeypatch, tmp_path, caplog):
    pytest.importorskip("xr", reason="needs pyopenxr")
    if not shutil.which("monado-service"):
        pytest.skip("needs monado-service, a runtime of OpenXR")
    monado = Monado(tmp_path, 20000 + (os.getpid() + 57) % 20000)
    try:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(monado.runtime))
        hands = find_hands(OpenXRConfig(use="on"))
        assert [str(hand).split(" of Monado")[0] for hand in hands] == ["right hand", "left hand"]

        def wish(right, left):
            monado.tell(right, left)
            time.sleep(0.1)
            return [hand.read() for hand in hands]

        place, there = (0.2, 1.2, -0.3), (0.206, 1.203, -0.303)
        left, turned = RemoteHand((-0.2, 1.2, -0.3)), (0, 0, *np.sin(np.deg2rad([2.5, 87.5])))
        for _ in range(2):
            assert not any(each.way.any() for each in wish(RemoteHand(place), left))
        wish(RemoteHand(place, squeeze=True), left)
        one, other = wish(RemoteHand(there, turned, squeeze=True, trigger=True), left)
        np.testing.assert_allclose([*one.way, one.turn], [1, 0.5, -0.5, 1], atol=1e-3)
        assert one.closed and one.hand == 0 and other.closed is None and other.hand == 1 and not other.way.any()
        one, other = wish(RemoteHand(place, a=True), RemoteHand(left.place, b=True))
        assert one.word == "again" and other.word == "finish" and one.closed is None and not one.way.any()
        one, _ = wish(RemoteHand(there, squeeze=True, seen=False), left)
        assert one.closed is None, "out of sight"
    finally:
        monado.stop()
    with caplog.at_level(logging.WARNING):
        assert not any(hand.read().way.any() for hand in (*hands, *hands))
    assert len(caplog.records) == 1 and "openxr: the runtime is gone (InstanceLostError); the mouse and the keys go on" in caplog.text
    for hand in hands:
        hand.close()
