"""Masters that speak CRTK, played by another process, in the hands of who demonstrates."""

import json
import logging
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from endo_sim_command import endo_sim_here
from waiting import wait_until

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.learning.by_person import demonstrate_by_person
from endo_sim_ros.learning.config import DemonstrationConfig, Randomisation, SightConfig
from endo_sim_ros.learning.demonstrations import Demonstrations, begin, demonstrate
from endo_sim_ros.learning.person_config import MastersConfig, PersonConfig
from endo_sim_ros.physics import MotionConfig

HERE = Path(__file__).parent


class Console:
    """The process that plays the masters."""

    def __init__(self, *names):
        self.process = subprocess.Popen([sys.executable, HERE / "played_master.py", *names], stdin=subprocess.PIPE, text=True)

    def say(self, **what):
        assert self.process.stdin is not None
        print(json.dumps(what), file=self.process.stdin, flush=True)

    def end(self):
        self.process.kill()
        self.process.wait(60)


def test_what_no_masters_can_be_is_refused(tmp_path):
    for options, said in (
        ({"names": ("MTMR", "MTMR")}, "MTMR MTMR must be one or two different names"),
        ({"names": ("MTMR", "/MTMR")}, "MTMR /MTMR must be one or two different names"),
        ({"clutch": "pedal", "operator": "/pedal"}, "clutch and operator are both pedal; give each its own"),
        ({"names": ("MTM R",)}, "'MTM R' cannot be a ROS name; give letters"),
        ({"axes": ("right", "up", "away")}, "right up away are no right-handed axes; the dVRK has left up away"),
        ({"closed": 0.5}, "closed, 0.5 rad, must be less than open, 0.4 rad"),
    ):
        with pytest.raises(ConfigError, match=said):
            MastersConfig(**options)
    assert PersonConfig(masters=MastersConfig(step=0.01)).without_effect() == [
        "masters have options, but no names; give them, as in MTMR MTML"
    ]


def test_without_rclpy_masters_are_refused_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delitem(sys.modules, "endo_sim_ros.graph.masters", raising=False)
    monkeypatch.setitem(sys.modules, "rclpy.context", None)
    done = endo_sim_here("demonstrate", "retraction", tmp_path / "out", "--by", "person", "--page.masters.names", "MTMR", "--device", "cpu")
    assert done.returncode == 2 and "page.masters needs rclpy" in done.stderr and "jazzy/setup.sh" in done.stderr


@pytest.mark.dds
def test_the_tip_follows_masters_that_speak_crtk(caplog, monkeypatch):
    from endo_sim_ros.graph import masters

    monkeypatch.setattr(masters, "_STARTS", 0.5)
    with pytest.raises(ValueError, match="nobody publishes MTMR/measured_cp and MTML/measured_cp; start the console"):
        masters.find_masters(MastersConfig(names=("MTMR", "MTML")))
    monkeypatch.setattr(masters, "_STARTS", 30.0)
    monkeypatch.setattr(masters, "_SILENT", 5.0)  # other processes of a machine that tests take their time
    console, hands = Console("MTMR", "MTML"), ()
    try:
        hands = masters.find_masters(MastersConfig(names=("MTMR", "MTML")))
        heard = hands[0]._hands
        assert isinstance(heard, masters.Masters) and str(hands[0]) == "master MTMR"
        ways, closed = np.zeros((2, 3)), []

        def look():
            for number, hand in enumerate(hands):
                wish = hand.read()
                assert wish.hand == number and not wish.gone
                ways[number] += wish.way
                if wish.closed is not None and number == 0:
                    closed.append(wish.closed)
            time.sleep(0.005)

        def until(done, what, **said):
            """Say something, and look until it is heard."""
            ways[:] = 0
            closed.clear()
            console.say(**said)
            wait_until(done, 10, what, look)
            for _ in range(20):
                look()

        def at(hand, x, y, z):
            return lambda: heard._poses[hand] is not None and np.allclose(heard._poses[hand][:3, 3], (x, y, z), atol=1e-4)

        until(lambda: all(pose is not None for pose in heard._poses), "both poses")
        until(lambda: True, "nothing")
        assert not ways.any() and not closed, "they rest, for all their noise"
        # x of the dVRK points to the left, z away from the person.
        until(at(0, -0.012, 0.006, 0.297), "the move", name="MTMR", place=[-0.012, 0.006, 0.297])
        np.testing.assert_allclose(ways, [[2, 1, 0.5], [0, 0, 0]], atol=0.03)
        until(lambda: closed, "the gripper", name="MTMR", gripper=0.1)
        until(lambda: True, "nothing", name="MTMR", gripper=0.3)
        assert set(closed) == {True}, "between the two angles it stays"
        until(lambda: heard._clutched, "the clutch", clutch=1)
        until(at(0, 0, 0, 0.3), "the move", name="MTMR", place=[0, 0, 0.3])
        assert not ways.any() and not closed, "it goes elsewhere"
        until(lambda: not heard._clutched, "the clutch", clutch=2)
        until(at(1, 0, 0.012, 0.3), "the move of the other", name="MTML", place=[0, 0.012, 0.3])
        np.testing.assert_allclose(ways, [[0, 0, 0], [0, 2, 0]], atol=0.03)
        until(lambda: closed, "the gripper", name="MTMR", gripper=0.5)
        assert set(closed) == {False}
        until(lambda: not heard._present, "that nobody is there", present=0)
        until(at(0, 0.1, 0, 0.3), "the move", name="MTMR", place=[0.1, 0, 0.3])
        assert not ways.any()
    finally:
        console.end()
    monkeypatch.setattr(masters, "_SILENT", 0.5)
    try:
        with caplog.at_level(logging.WARNING):
            wait_until(lambda: all([hand.read().gone for hand in hands]), 10, "both to be gone")
        told = sorted(record.getMessage() for record in caplog.records)  # the one that was heard last goes last
        assert told == [f"master {name} is gone; the mouse and the keys go on" for name in ("MTML", "MTMR")]
    finally:
        for hand in hands:
            hand.close()


@pytest.mark.dds
@pytest.mark.parametrize("refused", [False, True])
def test_a_master_from_which_nothing_comes_that_can_be_used_is_told(caplog, monkeypatch, refused):
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.context import Context

    from endo_sim_ros.graph import masters

    monkeypatch.setattr(masters, "_FIRST", 0.3)
    monkeypatch.setattr(masters, "_LATER", 0.2)
    monkeypatch.setattr(masters, "_SILENT", 5.0)
    context = Context()
    context.init(args=[])
    node, hands = rclpy.create_node("console", context=context), ()
    publisher = node.create_publisher(PoseStamped, "MTMR/measured_cp", 10)
    said = lambda: [record.getMessage() for record in caplog.records]
    try:
        with caplog.at_level(logging.WARNING):
            (hand,) = hands = masters.find_masters(MastersConfig(names=("MTMR",)))
            without = "nobody publishes MTMR/gripper/measured_js: no jaw closes by it; the key space of the page closes one"
            assert said() == [without]
            bad = PoseStamped()  # with a quaternion of zeros
            bad.pose.orientation.w = 0.0 if refused else 1.0
            wait_until(lambda: hand.read().gone, 10, "it to be silent", lambda: refused and publisher.publish(bad))
            message = PoseStamped()
            message.pose.orientation.w = 1.0
            wait_until(lambda: not hand.read().gone, 10, "it to be heard", lambda: publisher.publish(message))
        silent = (
            r"no pose on MTMR/measured_cp can be used \(.*quaternion.*\)\."
            if refused
            else r"nothing comes from MTMR/measured_cp; is it powered and homed\?"
        )
        first, *others, last = said()
        assert (first, last) == (without, "master MTMR is heard now")
        assert [text for text in others if re.fullmatch(silent + " The mouse and the keys go on", text)] == others[-1:]
    finally:
        for hand in hands:
            hand.close()
        node.destroy_node()
        context.shutdown()


class Watched:
    """A screen on which every step waits until the master is where a plan has it: [x, y, z of the tip from its start, gripper in rad]."""

    def __init__(self, console, heard, plan):
        self.console, self.heard, self.plan, self.lines = console, heard, iter(plan), ()

    def show(self, view):
        self.lines = view.lines

    def wait(self, until):
        *tip, gripper = next(self.plan)
        # Axes of the dVRK; 6 mm of the hand are 2 mm of the tip.
        place = np.array([0, 0, 0.3]) + 3 * np.array([-1, 1, -1]) * tip
        self.console.say(name="MTMR", place=place.tolist(), gripper=gripper)

        def there():
            grip = self.heard.grip(0)
            return grip is not None and np.allclose(grip.place, place, atol=5e-5) and grip.closed == (gripper < 0.3)

        wait_until(there, 10, "the master to be there", lambda: time.sleep(0.005))


@pytest.mark.dds
def test_a_person_demonstrates_by_a_master(tmp_path, monkeypatch):
    """A hand goes to the spot, closes its gripper and lifts it; columns are those of a script."""
    from endo_sim_ros.graph import masters

    monkeypatch.setattr(masters, "_SILENT", 5.0)
    config, sight = DemonstrationConfig(by="person", episodes=1, images="png"), SightConfig(image_width=32)
    data = Demonstrations("retraction", ["phantom:0"], tmp_path / "out", 1, config, sight, Randomisation(), MotionConfig(), "cpu")
    (_, seen) = begin(data.batches[0], [0])
    state = dict(zip(data.batches[0].task.observation_names, seen["state"][0]))
    spot = np.array([state[f"spot_from_tip_{axis}"] for axis in "xyz"]) * 0.02  # m
    lifted = spot + (0, 0, 0.011)
    plan = [
        *([(0, 0, 0, 1.0)] * 3),  # a rest
        *((*(share * spot), 1.0) for share in np.linspace(0, 1, 20)),
        *([(*spot, 0.0)] * 2),
        *((*(spot + share * (lifted - spot)), 0.0) for share in np.linspace(0, 1, 12)),
        *([(*lifted, 0.0)] * 8),
        *((*(lifted + (0, 0, 0.001 * step)), 1.0) for step in (0, 0, 0, 1, 2)),  # a rest, and a move that keeps what was solved
    ]
    console, hands = Console("MTMR"), ()
    try:
        hands = masters.find_masters(MastersConfig(names=("MTMR",)))
        heard = hands[0]._hands
        assert demonstrate_by_person(data, Watched(console, heard, plan), hands, PersonConfig(width=16)) == 1
    finally:
        for hand in hands:  # before: Fast DDS once crashed that ended a node as it heard of the end of another
            hand.close()
        console.end()
    (path,) = (tmp_path / "out").glob("data/*/*.parquet")
    table = pq.read_table(path)
    actions = np.array(table["action"].to_pylist())
    np.testing.assert_allclose(2e-3 * actions[:, :3].sum(0), lifted - (0, 0, 0.011 - 2e-3 * actions[actions[:, 3] > 0, 2].sum()), atol=1e-3)
    assert table["next.success"].to_pylist()[-1] and actions[0, 3] == -1 and actions[-1, 3] == 1
    demonstrate("retraction", ["phantom:0"], tmp_path / "script", replace(config, by="script", environments=1), sight, device="cpu")
    features = [json.loads((tmp_path / root / "meta/info.json").read_text())["features"] for root in ("out", "script")]
    assert features[0] == features[1]


@pytest.mark.thorough
@pytest.mark.dds
def test_the_command_hears_masters(tmp_path):
    pytest.importorskip("viser")
    words = ["demonstrate", "retraction", tmp_path / "out", "--by", "person", "--page.masters.names", "MTMR", "--device", "cpu"]
    words += ["--page.port", 20000 + (os.getpid() + 83) % 20000]
    console = Console("MTMR")
    command = subprocess.Popen(
        [sys.executable, "-u", "-m", "endo_sim_ros.cli", *map(str, words)], stdout=subprocess.PIPE, text=True, cwd=HERE.parents[1]
    )
    try:
        assert command.stdout is not None
        assert "heard as well: master MTMR;" in next(line for line in command.stdout if line.startswith("open http"))
    finally:
        command.terminate()
        assert command.wait(120) == 143
        console.end()
