"""Recordings as experiments: what is in them, what is missing, and what contradicts itself."""

import re
from dataclasses import replace

import numpy as np
import pytest
from made_touches import DEPTH, PHYSICS, RADIUS, STEP, STIFFNESS, SURFACE, S, Touches, flat_tissue, press, pressed, tip

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.identification.from_bag import read_experiments
from endo_sim_ros.identification.recording_config import RecordingConfig
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

NODES = flat_tissue()


def read(bag, physics=PHYSICS, nodes=NODES, **options):
    return read_experiments(bag, None, nodes, physics, RecordingConfig(**options))


def refused(bag, *texts, **options):
    """The sentence with which a recording is refused."""
    with pytest.raises((SequenceError, ConfigError)) as caught:
        read(bag, **options)
    sentence = str(caught.value)
    assert "\n" not in sentence and str(bag) in sentence
    for text in texts:
        assert re.search(text, sentence), sentence
    return sentence


def test_presses_become_experiments_with_their_forces(tmp_path):
    found = read(press(tmp_path / "bag", seconds=7.0, presses=(1.0, 4.0)))
    assert len(found.experiments) == found.touches == 2 and found.forces
    exact = "PSM1: tips scatter by 0.00 mm only; if they are exact, as simulated ones, give tip_noise 1e-4"
    assert found.findings == ["7.0 s of PSM1: 2 touches in 2 experiments of 1.9 s in all", exact]
    for each in found.experiments:
        assert each.step_duration == STEP and each.present.all() and not each.closed.any()
        depth = each.tips[:, 2] - tip(0.0)[2, 3]
        assert depth.max() == pytest.approx(DEPTH, abs=1e-4) and depth[0] < -0.005
        np.testing.assert_allclose(each.forces[:, 2], -STIFFNESS * depth.clip(0), atol=1e-6)
        np.testing.assert_allclose(each.forces[:, :2], 0, atol=1e-6)
        assert (each.force_noise, each.tip_noise, each.tracks, each.displacements) == (0.05, 0.0005, [], None)


def test_noise_that_is_given_as_that_of_exact_tips_is_not_asked_for(tmp_path):
    found = read(press(tmp_path / "bag"), tip_noise=1e-4)
    assert not any("tips scatter" in text for text in found.findings)


def test_links_that_may_have_touched_are_told_where_nothing_can_be_used(tmp_path):
    with Touches(tmp_path / "bag") as bag:
        for t in np.arange(0, 2, 0.01):
            bag.pose(t, tip(-0.05))
        bag.say(messages.tool_links("PSM1"), messages.encode_poses([np.eye(4)], S, "world", bag.types))
        bag.say(messages.tool_type("PSM1"), messages.encode_text("LARGE_NEEDLE_DRIVER", bag.types))
    refused(tmp_path / "bag", "never touches", "PSM1: the links of an instrument touched, too, unless .*record with link_contact:=false")


@pytest.mark.parametrize(("time", "experiments"), [(0.3, 2), (1.0, 1)])
def test_presses_of_tissue_that_still_remembers_the_last_one_are_one_experiment(tmp_path, time, experiments):
    bag = press(tmp_path / "bag", seconds=7.0, presses=(1.0, 4.0), offset=[0.0, 0, 0.3])
    found = read(bag, replace(PHYSICS, relaxation=0.5, relaxation_time=time))
    assert len(found.experiments) == experiments and found.touches == 2
    assert any("forces of 0.3 N while the tool touches nothing were taken off" in text for text in found.findings)


def test_poses_and_forces_are_turned_from_their_frames_into_the_world(tmp_path):
    base = rigid_pose([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.3, -0.1, 0.2])
    bag = press(tmp_path / "bag", frame="PSM1_base", base=base)
    (each,) = read(bag, frames=("PSM1_base 0.3 -0.1 0.2 0 0 0.70710678 0.70710678",)).experiments
    np.testing.assert_allclose(each.tips[:, :2], 0, atol=1e-6)
    np.testing.assert_allclose(each.rotations, np.tile(np.eye(3), (len(each.tips), 1, 1)), atol=1e-6)
    refused(bag, "PSM1_base", "frame")


def test_recorded_control_nodes_tell_how_the_skin_moved(tmp_path):
    times = np.arange(100) * STEP
    with Touches(tmp_path / "bag") as bag:
        for number, t in enumerate(times):
            depth = pressed(np.array([t]))[0]
            bag.pose(t, tip(depth))
            moved = np.zeros((len(NODES), 3))
            moved[:, 2] = 1e-5 * number
            bag.nodes(t, NODES, moved)
    found = read(tmp_path / "bag")
    (each,) = found.experiments
    shown = each.displacements[:, 0, 2] / 1e-5
    assert len(each.nodes) == 60 and each.displacements.shape == (len(each.tips), 60, 3)
    assert np.linalg.norm(NODES.rest[each.nodes] - [0, 0, SURFACE], axis=1).max() < 0.0301
    known = np.flatnonzero(np.isfinite(shown))
    np.testing.assert_array_equal(known, np.arange(0, len(shown), 5))  # 5 Hz
    deepest = np.argmax(each.tips[:, 2])  # of the press that begins at 1 s and lasts 1 s
    np.testing.assert_allclose(shown[known], known - deepest + 1.5 / STEP, atol=0.6)
    assert not found.forces
    assert any("control nodes were recorded" in text for text in found.findings)
    large = ControlNodes(1000 * NODES.rest, NODES.pinned, NODES.volumes, NODES.is_skin, 1000 * NODES.spacing, NODES.seen_from)
    refused(tmp_path / "bag", "never touches", "one scale", nodes=large)


def test_a_model_of_another_size_is_noticed_where_the_tool_would_touch_it(tmp_path):
    wide = ControlNodes(NODES.rest * np.float32([3.01, 3.01, 1]), NODES.pinned, NODES.volumes, NODES.is_skin, 1e-4, NODES.seen_from)
    with Touches(tmp_path / "bag") as bag:
        for t in np.arange(100) * STEP:
            bag.pose(t, tip(pressed(np.array([t]))[0]))
            bag.nodes(t, wide, np.zeros((len(wide), 3)))
    narrow = ControlNodes(NODES.rest, NODES.pinned, NODES.volumes, NODES.is_skin, 1e-9, NODES.seen_from)
    refused(tmp_path / "bag", "other tissue than the model", "span 171.4 mm, those of the model 60 mm", nodes=narrow)


def test_offset_and_noise_of_forces_are_told(tmp_path):
    found = read(press(tmp_path / "bag", seconds=8.0, noise=0.12, offset=np.array([0.0, 0.4, 0.0])))
    text = " ".join(found.findings)
    assert "N while the tool touches nothing were taken off" in text and "a noise of 0.1" in text
    (each,) = found.experiments
    assert each.force_noise == pytest.approx(0.12, rel=0.2) and abs(np.median(each.forces[:, 1])) < 0.1


def test_gaps_and_tissue_in_touch_at_first_are_told(tmp_path):
    found = read(press(tmp_path / "bag", seconds=7.0, presses=(-0.5, 3.0), leave_out=(5.0, 5.5)))
    assert len(found.experiments) == 1
    assert any("1 of 2 touches are left out" in text for text in found.findings)


BAD = {
    "no_touch": (dict(presses=(1.0,), depth=-0.008), {}, ("never touches the tissue", "after 1.5 s, to 8 mm", "one scale")),
    "far_forces": (
        dict(presses=(1.0,), depth=-0.005, force=lambda depth: 300 * max(depth + 0.007, 0)), {}, ("never touches", "forces of up to 0.6 N"),
    ),
    "wrong_sign": (dict(force=lambda depth: -STIFFNESS * max(depth, 0)), {}, ("the sign", "180 degrees", "measured_cf")),
    "other_clock": (dict(late=lambda t: 50_000.0), {}, ("share no moment", r"5e\+04 s after")),
    "poses_too_rare": (dict(rate=2.0), {}, ("more than longest_gap, 0.2 s, apart",)),
    "poses_rare_beside_touches": (dict(rate=3.125, presses=(1.0, 4.0)), {}, ("more than longest_gap, 0.2 s, apart",)),
    "always_in_tissue": (dict(presses=(-0.5, 0.4, 1.3, 2.2, 3.1), depth=0.1), {}, ("no experiment can be used", "not seen away")),
    "nothing_pushes_and_is_near": (dict(depth=-0.003), dict(physics=PhysicsConfig(step_duration=STEP)), ("contact_radius is 0, so that",)),
    "nothing_pushes": ({}, dict(physics=PhysicsConfig(step_duration=STEP)), ("contact_radius is 0", "press nothing")),
    "no_motion_recorded": ({}, dict(observed="images"), ("observed is images",)),
    "nothing_measured": (dict(forces=0.0), {}, ("nothing tells how the tissue answers",)),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_recording_is_refused_with_what_was_seen(tmp_path, name):
    made, options, texts = BAD[name]
    refused(press(tmp_path / "bag", **made), *texts, **options)


def test_a_known_delay_of_forces_is_taken_away(tmp_path):
    bag = press(tmp_path / "bag", seconds=8.0, presses=(1.0, 4.0), late=lambda t: 0.4)
    for each in read(bag, force_delay=0.4).experiments:
        depth = each.tips[:, 2] - tip(0.0)[2, 3]
        np.testing.assert_allclose(each.forces[:, 2], -STIFFNESS * depth.clip(0), atol=0.02)


def test_forces_that_are_askew_or_far_or_zero_are_told(tmp_path):
    with Touches(tmp_path / "askew") as bag:
        for t in np.arange(100) * STEP:
            depth = pressed(np.array([t]))[0]
            bag.pose(t, tip(depth))
            bag.force(t, [STIFFNESS * max(depth, 0.0), 0, 0])
    assert any("90 degrees from where tissue should push" in text for text in read(tmp_path / "askew").findings)
    far = press(tmp_path / "far", force=lambda depth: 300 * max(depth + 0.0098, 0))
    assert any(re.search("begin where the tool is [78] mm in front of", text) for text in read(far).findings)
    zero = press(tmp_path / "zero", depth=0.006, force=lambda depth: 0.0)
    told = refused(
        zero, "nothing tells how the tissue answers; .*all forces are 0, also where the tool is in the tissue", nodes=flat_tissue(0.004, 11)
    )
    assert "act as balls" not in told  # though it does among so few control nodes, that is beside the point


def test_a_tool_that_acts_as_thicker_than_it_is_said_to_be_is_told(tmp_path):
    bag = press(tmp_path / "bag")
    assert not any("act as balls" in text for text in read(bag).findings)
    told = read(bag, nodes=flat_tissue(0.004, 11)).findings
    assert any("tools act as balls of 6.0 mm radius, not of 4.0 mm" in text and "node_count" in text for text in told)


def test_other_arms_and_wrenches_are_no_part_of_an_experiment(tmp_path):
    with Touches(tmp_path / "two") as bag:
        for t in np.arange(300) * STEP:
            for arm, presses in (("PSM1", (1.0, 5.0)), ("PSM2", (5.0, 9.0))):
                depth = pressed(np.array([t]), presses)[0]
                bag.pose(t, tip(depth, 0.01 if arm == "PSM2" else 0.0), arm)
                bag.force(t, [0, 0, -STIFFNESS * max(depth, 0.0)], arm, arm)
    found = read(tmp_path / "two")
    assert len(found.experiments) == 2 and sum("touched the tissue, too" in text for text in found.findings) == 2
    assert len(read(tmp_path / "two", arms=("PSM1",)).experiments) == 2
    with Touches(tmp_path / "wrench") as bag:
        for t in np.arange(100) * STEP:
            bag.pose(t, tip(pressed(np.array([t]))[0]))
            bag.force(t, [0, 0, -0.1])
            stamp = 1000 * S + round(t * S)
            bag.say(messages.tool_wrench("PSM1"), messages.encode_wrench(np.array([0, 0, 1.0]), np.zeros(3), stamp, "world", bag.types))
    refused(tmp_path / "wrench", "pulled by a wrench")


def test_a_bag_without_poses_or_with_what_is_no_number_is_one_sentence(tmp_path):
    with Touches(tmp_path / "none") as bag:
        bag.force(0.0, [0, 0, 0])
    refused(tmp_path / "none", "no topic /PSM1/measured_cp")
    with Touches(tmp_path / "nan") as bag:
        pose = tip(0.0)
        pose[0, 3] = np.nan
        bag.pose(0.1, pose)
    refused(tmp_path / "nan", "no message of a topic can be used: PSM1/measured_cp: the pose is not finite")
    with pytest.raises(SequenceError, match="no such bag"):
        read(tmp_path / "nowhere")
    assert RADIUS == PHYSICS.contact_radius


def test_a_pose_that_is_no_number_among_others_is_left_out(tmp_path):
    found = read(press(tmp_path / "bag", broken=1.5))
    assert len(found.experiments) == 1 and found.experiments[0].present.all()
    assert any("a message is left out: PSM1/measured_cp: the pose is not finite" in text for text in found.findings)


def test_a_recording_of_one_short_press_is_enough(tmp_path):
    (each,) = read(press(tmp_path / "bag", seconds=1.8, presses=(0.5,))).experiments
    assert np.linalg.norm(each.forces, axis=1).max() == pytest.approx(STIFFNESS * DEPTH, rel=0.05)


def test_grasps_that_slip_or_begin_with_a_press_are_experiments_like_others(tmp_path):
    with Touches(tmp_path / "slips") as bag:  # down to the skin, up with tissue that slips away halfway, and open
        for t in np.arange(0, 10, STEP):
            height = np.interp(t % 5, [0, 1, 1.5, 3, 4], [0.02, 0, 0, 0.008, 0.02])
            bag.pose(t, tip(-height))
            bag.jaw(t, 0.0 if 1.2 < t % 5 < 3.5 else 0.8)
            bag.force(t, [0, 0, STIFFNESS * height if 1.2 < t % 5 < 2.2 else 0.0])
    found = read(tmp_path / "slips", physics=PhysicsConfig(contact_radius=0.0, step_duration=STEP, layers=1, force_radius=0.008))
    assert len(found.experiments) == 2 and all(each.closed.any() for each in found.experiments)
    with Touches(tmp_path / "pressed") as bag:  # the jaw closes 8 mm deep, and the ball still presses while it goes up by 6 mm
        for t in np.arange(0, 5, STEP):
            depth = np.interp(t, [0, 1, 1.5, 3, 3.5, 4], [-0.02, 0.008, 0.008, 0.002, 0.002, -0.02])
            bag.pose(t, tip(depth))
            bag.jaw(t, 0.0 if 1.2 < t < 3.5 else 0.8)
            bag.force(t, [0, 0, -STIFFNESS * max(depth, 0.0)])
    assert len(read(tmp_path / "pressed").experiments) == 1


@pytest.mark.parametrize("scatter, told", [(0.0005, None), (0.002, "mm, more than tip_noise, 0.5 mm; give that")])
def test_the_noise_of_tips_is_measured(tmp_path, scatter, told):
    rng = np.random.default_rng(0)
    with Touches(tmp_path / "bag") as bag:
        for t in np.arange(300) * STEP:
            depth = pressed(np.array([t]), (3.0, 8.0), duration=3.0, depth=0.006)[0]
            pose = tip(depth)
            pose[:3, 3] += scatter * rng.normal(size=3)
            bag.pose(t, pose)
            bag.force(t, [0, 0, -STIFFNESS * max(depth, 0.0)])
    said = [text for text in read(tmp_path / "bag").findings if "scatter" in text]
    assert not said if told is None else told in said[0]
