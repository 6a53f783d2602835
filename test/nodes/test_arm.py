"""An arm without a robot: the states of CRTK, and moves that take their time."""

import contextlib
import importlib.util
import sys
import types
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import make_pose
from endo_sim_ros.nodes.arm import Arm

TURNED = np.array([np.cos(0.3), 0.0, 0.0, np.sin(0.3)])  # 0.6 rad about z


@pytest.mark.parametrize("state, command, after", [
    ("ENABLED", "enable", "ENABLED"), ("ENABLED", "disable", "DISABLED"), ("ENABLED", "pause", "PAUSED"), ("ENABLED", "resume", None),
    ("DISABLED", "enable", "ENABLED"), ("DISABLED", "disable", "DISABLED"), ("DISABLED", "pause", None), ("DISABLED", "resume", None),
    ("PAUSED", "enable", None), ("PAUSED", "disable", "DISABLED"), ("PAUSED", "pause", "PAUSED"), ("PAUSED", "resume", "ENABLED"),
])  # fmt: skip
def test_states_change_as_crtk_says(state, command, after):
    arm = Arm("PSM1", state=state)
    if after is None:
        with pytest.raises(ValueError, match=f"{command} is not possible while PSM1 is {state}"):
            arm.command_state(command)
    else:
        arm.command_state(command)
    assert arm.state == (after or state)


def test_an_arm_needs_no_homing_but_remembers_it():
    arm = Arm("PSM1")
    assert arm.homed
    arm.command_state("unhome")
    assert not arm.homed and arm.state == "ENABLED"
    arm.command_state("home")
    assert arm.homed
    with pytest.raises(ValueError, match="'fly' is no state command; there are enable, disable, pause, resume, home, unhome"):
        arm.command_state("fly")


@pytest.mark.parametrize("turn_speed, seconds", [(10.0, 1.0), (0.3, 2.0)])  # the way or the turn takes longer
def test_a_move_is_straight_steady_and_as_fast_as_both_speeds_allow(turn_speed, seconds):
    arm = Arm("PSM1", make_pose(np.zeros(3), np.array([1.0, 0, 0, 0])))
    arm.pose_goal = goal = make_pose(np.array([0.03, 0.04, 0.0]), TURNED)
    way, turns = [], []
    for _ in range(round(seconds / 0.04)):
        assert arm.busy
        arm.move(0.04, 0.05, turn_speed)
        way.append(arm.pose[:3, 3])
        turns.append(np.arctan2(arm.pose[1, 0], arm.pose[0, 0]))
    assert not arm.busy
    np.testing.assert_array_equal(arm.pose, goal)
    parts = np.arange(1, len(way) + 1) / len(way)
    np.testing.assert_allclose(way, parts[:, None] * [0.03, 0.04, 0.0], atol=1e-9)
    np.testing.assert_allclose(turns, 0.6 * parts, atol=1e-9)


def test_a_jaw_closes_on_its_way_and_opens_again():
    arm, closed = Arm("PSM1"), []
    for goal in (0.0, 0.5):
        arm.angle_goal = goal
        while arm.busy:
            arm.move(0.1, 0.05, 1.0)
            arm.hold(0.15, 0.25)
            closed.append(arm.closed)
        assert arm.angle == goal
    assert closed == [False] * 8 + [True] * 4 + [False] * 3


def test_a_paused_arm_stays_where_it_is_and_a_disabled_one_lets_go():
    arm = Arm("PSM1", np.eye(4), force=np.ones(3), torque=np.ones(3), cutting=True, closed=True)
    arm.pose_goal, arm.angle_goal = make_pose(np.ones(3), TURNED), 0.0
    arm.command_state("pause")
    assert not arm.busy and arm.force.any() and arm.closed
    with pytest.raises(ValueError, match="PSM1 is PAUSED; send resume on PSM1/state_command"):
        arm.require_enabled()
    arm.command_state("disable")
    assert arm.force is None and arm.torque is None and not arm.cutting and not arm.closed
    with pytest.raises(ValueError, match="PSM1 is DISABLED; send enable"):
        arm.require_enabled()


def test_a_reset_lets_go_of_force_and_torque():
    arm = Arm("PSM1", np.eye(4), force=np.ones(3), torque=np.ones(3), closed=True)
    arm.reset()
    assert arm.force is None and arm.torque is None and not arm.closed


@pytest.fixture
def crtk(monkeypatch):
    """Stands for crtk_msgs, which is not on PyPI: types with its fields."""

    @dataclass
    class OperatingState:
        header: Any
        state: str
        is_homed: bool
        is_busy: bool

    @dataclass
    class StringStamped:
        string: str

    package = types.ModuleType("crtk_msgs")
    package.__spec__ = types.SimpleNamespace(name="crtk_msgs")
    package.msg = types.ModuleType("crtk_msgs.msg")
    package.msg.OperatingState, package.msg.StringStamped = OperatingState, StringStamped
    monkeypatch.setitem(sys.modules, "crtk_msgs", package)
    monkeypatch.setitem(sys.modules, "crtk_msgs.msg", package.msg)
    with forgotten_types():
        yield package.msg


@contextlib.contextmanager
def forgotten_types():
    """Context in which types of messages are looked for anew."""
    cached = messages.crtk_type, messages.ros_class
    for function in cached:
        function.cache_clear()
    yield
    for function in cached:
        function.cache_clear()


@pytest.mark.skipif(importlib.util.find_spec("crtk_msgs") is not None, reason="crtk_msgs is installed")
def test_a_folder_with_the_sources_of_crtk_msgs_does_not_install_it(tmp_path, monkeypatch):
    (tmp_path / "crtk_msgs" / "msg").mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path)
    with forgotten_types():
        assert messages.tool_state("PSM1").type == "std_msgs/msg/String"
        assert messages.encode_operating_state("PAUSED", True, False, 5).data == "PAUSED"


def test_states_travel_in_the_types_of_crtk_where_they_are_installed(crtk):
    assert messages.tool_state("PSM1") == ("PSM1/operating_state", "crtk_msgs/msg/OperatingState", "latched")
    assert messages.tool_state_command("PSM1").type == "crtk_msgs/msg/StringStamped"
    told = messages.encode_operating_state("PAUSED", True, False, 5)
    assert (told.state, told.is_homed, told.is_busy, told.header.stamp.nanosec) == ("PAUSED", True, False, 5)
    assert messages.decode_state_command(crtk.StringStamped("home")) == "home"
