"""Episodes that pair what belongs together, and recordings that cannot be rows."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from made_recordings import BEGIN, HEIGHT, STEP, WIDTH, Recording, joints, lockstep, realtime, tip
from scipy.spatial.transform import Rotation
from thorough import mostly_thorough

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.episodes import (
    JAW_OPEN,
    NEAREST,
    _arms,
    action_names,
    environment_names,
    read_episode,
    state_names,
    summarize_tissue,
)
from endo_sim_ros.learning.lerobot import export_lerobot
from endo_sim_ros.messages import ControlNodeCloud
from endo_sim_ros.sequences.bag import BagWriter

S = 1_000_000_000


def column(episode, name):
    for names, values in (
        (state_names, episode.state), (action_names, episode.action), (environment_names, episode.environment_state),
    ):  # fmt: skip
        if name in names(episode.arms):
            return values[:, names(episode.arms).index(name)]
    raise KeyError(name)


def test_last_steps_that_were_not_rendered_are_left_out_and_told(tmp_path, caplog):
    with Recording(tmp_path / "bag") as recording:
        for number in range(8):
            recording.act(STEP * number, number)
            recording.observe(STEP * number, number, leave_out=(messages.RENDERED_IMAGE,) if number > 5 else ())
    assert len(read_episode(tmp_path / "bag")) == 5 and "the last 2 of 8 steps have no picture" in caplog.text


@pytest.mark.slow
def test_steps_in_lockstep_are_paired_by_their_stamps(tmp_path):
    episode = read_episode(lockstep(tmp_path / "bag"))
    assert episode.lockstep and episode.fps == 25 and len(episode) == 11 and episode.arms == ("PSM1",)
    observed = np.arange(11)
    np.testing.assert_array_equal(episode.left.numbers, observed)
    np.testing.assert_allclose(column(episode, "mean_displacement_x"), 1e-4 * observed * 17 / 16, atol=1e-8)
    np.testing.assert_allclose(column(episode, "PSM1.x"), 1e-3 * observed, atol=1e-8)
    # the action of a row made the observation of the next
    np.testing.assert_allclose(episode.action[:, 0], 1e-3 * (observed + 1), atol=1e-8)
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), -(observed + 1.0))
    np.testing.assert_allclose(column(episode, "PSM1.torque_y"), observed + 1.0)
    np.testing.assert_allclose(episode.action[:, 7], 0.01 * (observed + 1), atol=1e-7)


@pytest.mark.slow
def test_the_first_observation_needs_no_command(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        recording.act(-S, 0)  # once before the steps begin, as to say where the tool is
        for number in range(5):
            if number:
                recording.act(STEP * number, number)
            recording.observe(STEP * number, number)
    episode = read_episode(tmp_path / "bag")
    assert episode.lockstep and len(episode) == 4
    np.testing.assert_array_equal(episode.left.numbers, [0, 1, 2, 3])
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), [-1, -2, -3, -4])


@pytest.mark.slow
@pytest.mark.parametrize("reset", [-9 * S, 3600 * S], ids=["early", "late"])
def test_observations_after_a_reset_may_bear_any_time(tmp_path, reset, caplog):
    """In lockstep they bear the stamp of the model, whatever the policy's stamps are."""
    with Recording(tmp_path / "bag") as recording:
        recording.observe(reset, 0)
        for number in range(1, 40):
            recording.act(STEP * number, number)
            recording.observe(STEP * number, number)
        recording.observe(reset, 0)
    episode = read_episode(tmp_path / "bag")
    early = reset < 0  # then it is the first observation
    assert episode.lockstep and len(episode) == 38 + early and "missing" not in caplog.text
    np.testing.assert_array_equal(episode.left.numbers, np.arange(0 if early else 1, 39))
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), -np.arange(1.0 if early else 2.0, 40))


@pytest.mark.slow
def test_two_runs_in_one_bag_are_refused(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        for _ in range(2):
            for number in range(40):
                recording.act(STEP * number, number)
                recording.observe(STEP * number, number)
    with pytest.raises(SequenceError, match="bag: /.*: time goes back, as after a reset; record each episode into a bag of its own"):
        read_episode(tmp_path / "bag")


def test_a_missing_step_is_left_out_and_told(tmp_path, caplog):
    episode = read_episode(lockstep(tmp_path / "bag", missing=(5,)))
    assert len(episode) == 10 and "1 of 12 steps are missing" in caplog.text
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), [-1, -2, -3, -4, -6, -7, -8, -9, -10, -11])


def test_where_no_command_was_recorded_the_next_pose_is_the_action_and_that_is_told(tmp_path, caplog):
    """The poses of a robot move the tool without any command; a recorder that came late may have missed some."""
    told = "actions of PSM1 are where the tip was measured next, as nothing was recorded yet on /PSM1/servo_cp or /PSM1/setpoint_cp"
    episode = read_episode(lockstep(tmp_path / "none"))
    assert f"none: 11 of 11 {told}" in caplog.text
    np.testing.assert_allclose(episode.action[:, :7], [*episode.state[1:, :7], episode.action[-1, :7]])
    for first, expected in ((4, f"bag4: 3 of 5 {told}"), (0, "")):
        caplog.clear()
        with Recording(tmp_path / f"bag{first}") as recording:
            for number in range(6):
                recording.act(STEP * number, number)
                recording.observe(STEP * number, number)
                if number >= first:
                    recording.command(STEP * number, number)
        episode = read_episode(tmp_path / f"bag{first}")
        assert (expected in caplog.text) if expected else not caplog.text
        aside = np.arange(1, 6) >= first
        np.testing.assert_allclose(episode.action[:, 1], 0.01 + 0.02 * aside, atol=1e-7)


def test_an_arm_that_servo_commands_do_not_drive_does_what_its_setpoints_say(tmp_path, caplog):
    """As one that is told goals of moves, or joints."""
    for first in (99, 4):  # from when on servo commands drive it
        with Recording(tmp_path / f"bag{first}") as recording:
            for number in range(6):
                stamp, types, goal = BEGIN + STEP * number, recording.types, tip(number)
                goal[2, 3] += 0.03
                recording.act(STEP * number, number, leave_out=() if number >= first else (messages.tool_jaw("PSM1"),))
                recording.write([
                    (messages.tool_setpoint("PSM1"), messages.encode_pose(goal, stamp, "world", types)),
                    (messages.tool_jaw_setpoint("PSM1"), messages.encode_jaw(0.5 + 0.1 * number, stamp, types)),
                    (messages.tool_jaw_state("PSM1"), messages.encode_jaw(0.4, stamp, types)),
                ])  # fmt: skip
                recording.observe(STEP * number, number)
                if number >= first:
                    recording.command(STEP * number, number)
        episode, following = read_episode(tmp_path / f"bag{first}"), np.arange(1, 6)
        servo = following >= first
        np.testing.assert_allclose(episode.action[:, 1], 0.01 + 0.02 * servo, atol=1e-7)
        np.testing.assert_allclose(episode.action[:, 2], 0.1 + 0.03 * ~servo, atol=1e-7)
        np.testing.assert_allclose(episode.action[:, 7], np.where(servo, 0.01 * following, 0.5 + 0.1 * following), atol=1e-7)
        np.testing.assert_allclose(column(episode, "PSM1.jaw"), 0.4)
    assert not caplog.text


def test_a_move_takes_over_from_servo_commands_and_damaged_setpoints_do_not_count(tmp_path, caplog):
    """Half a second after the last servo command the setpoint counts; ahead of the first setpoint what was measured."""
    with Recording(tmp_path / "bag") as recording:
        for number in range(20):
            stamp, types, goal = BEGIN + STEP * number, recording.types, tip(number)
            goal[2, 3] += 0.03
            recording.act(STEP * number, number, leave_out=() if number == 4 else (messages.tool_jaw("PSM1"),))
            messages_now = [(messages.tool_jaw_state("PSM1"), messages.encode_jaw(0.4, stamp, types))]
            if number >= 2:
                messages_now.append((messages.tool_setpoint("PSM1"), messages.encode_pose(goal, stamp, "world", types)))
                messages_now.append((messages.tool_jaw_setpoint("PSM1"), messages.encode_jaw(np.nan, stamp, types)))
            recording.write(messages_now)
            recording.observe(STEP * number, number)
            if number == 4:
                recording.command(STEP * number, number)
    episode, following = read_episode(tmp_path / "bag"), np.arange(1, 20)
    servo = (following >= 4) & ((following - 4) * STEP <= 500_000_000)
    assert servo.sum() < 15
    moved = ~servo & (following >= 2)
    np.testing.assert_allclose(episode.action[:, 2], 0.1 + 0.03 * moved, atol=1e-7)
    np.testing.assert_allclose(episode.action[:, 7], np.where(following >= 4, 0.04, 0.4), atol=1e-7)
    assert "bag: 1 of 19 actions of PSM1 are where the tip was measured next" in caplog.text


@pytest.mark.parametrize("nameless", [False, True])
def test_poses_in_the_view_of_the_camera_are_where_it_was_at_their_time(tmp_path, nameless):
    """As clients of the dVRK have them; their commands may have no frame, which is that of measured poses then."""
    turned = Rotation.from_euler("xyz", [2.8, 0.3, 0.2])
    turns = [(turned * Rotation.from_rotvec([0, 0.05 * number, 0])).as_matrix() for number in range(6)]
    camera = lambda number: rigid_pose(turns[number], [0.02 * number, 0.1, -0.3 + 0.01 * number])
    for name in ("world", "view", "nobody"):
        with Recording(tmp_path / name) as recording:
            for number in range(6):
                stamp, view = BEGIN + STEP * number, camera(number) @ np.diag([-1.0, -1, 1, 1])
                if name == "view":
                    recording.write([(messages.CAMERA_POSE, messages.encode_pose(camera(number), stamp, "world", recording.types))])
                recording.act(STEP * number, number, base=None if name == "world" else ("ECM_view", view))
                if name == "world":
                    recording.command(STEP * number, number)
                else:
                    goal = tip(number)
                    goal[1, 3] += 0.02
                    frame = "" if nameless else "ECM_view"
                    command = messages.encode_pose(np.linalg.inv(view) @ goal, stamp, frame, recording.types)
                    recording.write([(messages.tool_pose_command("PSM1"), command)])
                recording.observe(STEP * number, number)
    world, view = (read_episode(tmp_path / name) for name in ("world", "view"))
    np.testing.assert_allclose(view.state, world.state, atol=1e-6)
    np.testing.assert_allclose(view.action, world.action, atol=1e-6)
    with pytest.raises(SequenceError, match="nobody: poses are in ECM_view, .* no ECM/measured_cp .*; record it, too, or record with cart"):
        read_episode(tmp_path / "nobody")


def test_what_edges_are_told_is_part_of_what_is_done_where_it_was_recorded(tmp_path):
    arms, cut = ("PSM1", "PSM2"), messages.tool_cut("PSM1")
    with Recording(tmp_path / "bag") as recording:
        for number in range(6):
            recording.act(STEP * number, number, arms)
            if number in (2, 4):
                recording.write([(cut, messages.encode_cut(number == 2, BEGIN + STEP * number, recording.types))])
            recording.observe(STEP * number, number, arms)
    assert read_episode(tmp_path / "bag").cut.T.tolist() == [[0, 1, 1, 0, 0], [0] * 5]
    assert read_episode(lockstep(tmp_path / "whole")).cut is None
    export_lerobot([tmp_path / "bag"], tmp_path / "out", "cut", images="png")
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    assert features["action"]["names"][-2:] == ["PSM1.cut", "PSM2.cut"] and features["action"]["shape"] == [30]
    table = pq.read_table(next((tmp_path / "out").glob("data/*/*.parquet")))
    assert [row[-2] for row in table.column("action").to_pylist()] == [0, 1, 1, 0, 0]


def test_a_jaw_that_speaks_now_and_then_keeps_its_angle(tmp_path):
    jaw = messages.tool_jaw("PSM1")
    with Recording(tmp_path / "bag") as recording:
        for number in range(6):
            recording.act(STEP * number, number, leave_out=() if number == 3 else (jaw,))
            recording.observe(STEP * number, number)
    episode = read_episode(tmp_path / "bag")
    assert episode.lockstep
    np.testing.assert_allclose(episode.action[:, 7], [JAW_OPEN, JAW_OPEN, 0.03, 0.03, 0.03], atol=1e-7)
    np.testing.assert_allclose(column(episode, "PSM1.jaw")[:3], JAW_OPEN)


def test_at_a_rate_the_last_message_counts(bag):
    episode = read_episode(bag)
    assert not episode.lockstep and episode.fps == 25
    assert len(episode) == 49  # 50 observations from 0.003 s; the last has no action
    observed = np.arange(49)
    np.testing.assert_array_equal(episode.left.numbers, observed)
    np.testing.assert_allclose(column(episode, "PSM1.x"), 1e-3 * 4 * observed, atol=1e-8)  # tick 4k came at 0.04 k + 0.001
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), -4.0 * (observed + 1))


@pytest.mark.slow
def test_another_rate_repeats_or_skips(bag):
    fast, slow = read_episode(bag, fps=50), read_episode(bag, fps=5)
    np.testing.assert_array_equal(fast.left.numbers, np.arange(98) // 2)
    np.testing.assert_array_equal(slow.left.numbers, np.arange(len(slow)) * 5)
    np.testing.assert_allclose(column(slow, "PSM1.force_z"), -20.0 * (np.arange(len(slow)) + 1))


@pytest.mark.slow
def test_lockstep_recordings_can_be_sampled_at_a_rate(tmp_path):
    path = lockstep(tmp_path / "bag")
    assert read_episode(path, sampling="rate").lockstep is False
    ten = read_episode(path, fps=10)
    assert not ten.lockstep and ten.fps == 10
    assert read_episode(path, fps=25).lockstep
    with pytest.raises(SequenceError, match="its steps are 25 per second, not 10"):
        read_episode(path, fps=10, sampling="lockstep")


@pytest.mark.slow
def test_wrenches_are_turned_into_the_axes_of_the_world(bag, tmp_path):
    episode = read_episode(bag)
    np.testing.assert_allclose(column(episode, "PSM1.reaction_force_y"), np.arange(49))  # was along x of the turned tip
    np.testing.assert_allclose(column(episode, "PSM1.reaction_force_x"), 0, atol=1e-5)
    np.testing.assert_allclose(column(episode, "PSM1.reaction_torque_z"), np.arange(49))
    for frame in ("PSM1", ""):
        body = read_episode(realtime(tmp_path / f"bag{frame}", frame=frame, seconds=1))
        np.testing.assert_allclose(column(body, "PSM1.torque_x"), -4.0 * (np.arange(len(body)) + 1), atol=1e-4)


BASE = np.array([[0.0, 0, 1, 0.1], [0, 1, 0, -0.05], [-1, 0, 0, 0.02], [0, 0, 0, 1]])  # its z axis is the world's x axis
FRAMES = (f"PSM1_base 0.1 -0.05 0.02 0 {0.5**0.5} 0 {0.5**0.5}",)


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(["PSM1_base", ""]))
def test_poses_and_wrenches_in_the_frame_of_a_base_are_turned_into_the_world(bag, tmp_path, name):
    path = realtime(tmp_path / "bag", base=(name, BASE), frame="PSM1_base")
    with pytest.raises(SequenceError, match="bag: PSM1/.*: unknown frame 'PSM1_base'"):
        read_episode(path)
    episode, expected = read_episode(path, frames=FRAMES), read_episode(bag)
    np.testing.assert_allclose(episode.state, expected.state, atol=1e-5)
    np.testing.assert_allclose(episode.environment_state, expected.environment_state, atol=1e-6)
    np.testing.assert_allclose(episode.action[:, :8], expected.action[:, :8], atol=1e-6)
    for axis_of_base, axis in (("force_z", "force_x"), ("torque_y", "torque_y")):
        np.testing.assert_allclose(column(episode, f"PSM1.{axis}"), column(expected, f"PSM1.{axis_of_base}"), atol=1e-4)
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), 0, atol=1e-4)
    assert export_lerobot([path], tmp_path / "out", "t", frames=FRAMES) == (1, 49)
    with pytest.raises(ValueError, match="frames: 'PSM1_base 1' is not a name and seven numbers"):
        read_episode(path, frames=("PSM1_base 1",))


@pytest.mark.slow
def test_poses_without_a_frame_are_in_the_world_when_the_base_is_not_named(bag, tmp_path):
    episode = read_episode(realtime(tmp_path / "bag", base=("", np.eye(4))))
    np.testing.assert_array_equal(episode.state, read_episode(bag).state)


@pytest.mark.slow
def test_stamps_shared_in_real_time_are_not_taken_for_lockstep(tmp_path, caplog):
    """As those of an arm without a robot, or of a policy that answers with the stamp of what it saw."""
    caplog.set_level("INFO")
    rng = np.random.default_rng(0)
    with Recording(tmp_path / "bag") as recording:
        for number in range(40):
            stamp = STEP * number + int(rng.uniform(0, S // 500))
            recording.act(stamp, number)
            recording.observe(stamp, number)
    episode = read_episode(tmp_path / "bag")
    assert not episode.lockstep and episode.fps == 25 and "as in real time; it is sampled at a rate" in caplog.text
    assert read_episode(tmp_path / "bag", sampling="lockstep").lockstep


def test_quaternions_do_not_jump(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        for number in range(20):
            recording.act(STEP * number, number, leave_out=(messages.tool_pose("PSM1"),))
            angle = 0.35 * number + 0.1  # more than a whole turn
            pose = np.eye(4)
            pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            stamp = BEGIN + STEP * number
            message = messages.encode_pose(pose, stamp, "world", recording.types)
            recording.write([(messages.tool_pose("PSM1"), message)])
            recording.observe(STEP * number, number)
    episode = read_episode(tmp_path / "bag")
    quats, commanded = episode.state[:, 3:7], episode.action[:, 3:7]
    assert ((quats[1:] * quats[:-1]).sum(1) > 0.9).all() and quats[:, 3].min() < -0.9
    np.testing.assert_allclose(commanded[:-1], quats[1:], atol=1e-6)


@pytest.mark.slow
def test_commanded_poses_are_the_action_where_there_are_any(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        for number in range(8):
            stamp = BEGIN + STEP * number
            recording.act(STEP * number, number)
            command = messages.encode_pose(tip(100 + number), stamp, "world", recording.types)
            recording.write([(messages.tool_pose_command("PSM1"), command)])
            recording.write([(messages.tool_jaw_state("PSM1"), messages.encode_jaw(0.5, stamp, recording.types))])
            recording.observe(STEP * number, number)
    episode = read_episode(tmp_path / "bag")
    np.testing.assert_allclose(episode.action[:, 0], 1e-3 * (101 + np.arange(7)), atol=1e-7)
    np.testing.assert_allclose(episode.state[:, 0], 1e-3 * np.arange(7), atol=1e-7)
    np.testing.assert_allclose(column(episode, "PSM1.jaw"), 0.5)


@pytest.mark.slow
def test_two_arms_have_columns_of_their_own(two_arms):
    both, second = read_episode(two_arms), read_episode(two_arms, arms=("PSM2",))
    assert both.arms == ("PSM1", "PSM2") and both.state.shape[1] == both.action.shape[1] == 28
    assert len(state_names(both.arms)) == 28 == len(set(action_names(both.arms)))
    assert both.environment_state.shape[1] == 16 == len(set(environment_names(both.arms)))
    np.testing.assert_array_equal(both.state[:, 14:], second.state)
    np.testing.assert_allclose(column(both, "PSM2.y"), -0.01, atol=1e-8)
    np.testing.assert_array_equal(both.environment_state[:, 10:], second.environment_state[:, 4:])


def test_joints_of_arms_that_do_not_tell_theirs_are_those_of_joint_states(tmp_path):
    """As of the scripted tool of the demo, and of robots: physics_node finds their joints from where the tip is."""
    arms = "PSM1", "left/PSM2"
    with Recording(tmp_path / "bag") as recording:
        for number in range(6):
            recording.act(STEP * number, number, arms)
            recording.observe(STEP * number, number, arms)
            if number > 1:  # it is published while somebody subscribes
                recording.tell_joints(STEP * number, number, arms[::-1] if number > 2 else arms[:1])
    expected = [[*joints(max(k, 2)) + (k > 2), *joints(max(k, 3))] for k in range(5)]
    np.testing.assert_allclose(read_episode(tmp_path / "bag", arms=arms).joints, expected, atol=1e-6)
    assert read_episode(lockstep(tmp_path / "none")).joints is None


def test_tissue_is_summarized_around_each_tip():
    rng = np.random.default_rng(0)
    rest, moved = rng.normal(size=(500, 3)).astype(np.float32), rng.normal(size=(500, 3)).astype(np.float32)
    cloud = ControlNodeCloud(rest, rest + moved, np.zeros((500, 3, 3), np.float32), 1)
    tips = rng.normal(size=(2, 3))
    summary = summarize_tissue(cloud, tips)
    np.testing.assert_allclose(summary[:3], moved.mean(0), atol=1e-6)
    assert summary[3] == pytest.approx(np.linalg.norm(moved, axis=1).max(), rel=1e-5)
    for arm, position in enumerate(tips):
        near = np.argsort(np.linalg.norm(cloud.positions - position, axis=1))[:NEAREST]
        part = summary[4 + 6 * arm :][:6]
        np.testing.assert_allclose(part[:3], cloud.positions[near].mean(0) - position, atol=1e-5)
        np.testing.assert_allclose(part[3:], moved[near].mean(0), atol=1e-5)
    few = ControlNodeCloud(rest[:1], rest[:1], cloud.F[:1], 1)
    assert summarize_tissue(few, tips).shape == (16,)


@pytest.mark.slow
def test_images_are_those_of_their_rows(bag):
    episode = read_episode(bag, fps=50)
    shown = [image[0, 0, 0] // 2 for image in episode.images()]
    np.testing.assert_array_equal(shown, episode.left.numbers)


def test_compressed_images_do_as_well(tmp_path):
    raw, compressed = (read_episode(lockstep(tmp_path / str(each), compressed=each)) for each in (False, True))
    assert compressed.left.topic == messages.RENDERED_COMPRESSED and compressed.left.size == raw.left.size
    for name in ("state", "action", "environment_state"):
        np.testing.assert_array_equal(getattr(raw, name), getattr(compressed, name))
    for exact, near in zip(raw.images(), compressed.images(), strict=True):
        assert np.abs(exact.astype(int) - near).mean() < 3


@pytest.mark.parametrize(
    "topic", [messages.RENDERED_IMAGE, messages.CONTROL_NODES, messages.tool_reaction("PSM1"), messages.tool_pose("PSM1")]
)
def test_a_missing_topic_is_named_with_what_there_is(tmp_path, topic):
    realtime(tmp_path / "bag", 0.5, leave_out=(topic,))
    with pytest.raises(SequenceError, match=rf"bag: no topic /{topic.name}; the bag has .*/PSM1/body/servo_cf"):
        read_episode(tmp_path / "bag")


def test_a_missing_arm_is_named(bag):
    with pytest.raises(SequenceError, match="no topic /PSM2/body/measured_cf; the bag has"):
        read_episode(bag, arms=("PSM2",))


def test_an_empty_recording_says_so(tmp_path):
    with BagWriter(tmp_path / "bag"):
        pass
    with pytest.raises(SequenceError, match="bag: the recording is empty; was the graph running"):
        read_episode(tmp_path / "bag")


@pytest.mark.slow
def test_recordings_that_cannot_be_rows_say_why(tmp_path):
    with pytest.raises(SequenceError, match="less than 0.04 s in common; record longer"):
        read_episode(realtime(tmp_path / "short", 0.03))
    with pytest.raises(SequenceError, match="share no stamps; sample at a rate instead"):
        read_episode(realtime(tmp_path / "rate", 0.5), sampling="lockstep")
    odd = lockstep(tmp_path / "odd", step=S // 100 * 7)
    with pytest.raises(SequenceError, match="steps of 70 ms make no whole number of frames per second; sample at a rate"):
        read_episode(odd)
    assert read_episode(odd, fps=20).fps == 20
    with pytest.raises(SequenceError, match="fps must be positive, got 0"):
        read_episode(odd, fps=0)


def test_messages_without_a_time_do_not_count(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        recording.act(0, 0)
        recording.observe(-BEGIN, 0)
    with pytest.raises(SequenceError, match="no message with a time on /rendered/image_raw"):
        read_episode(tmp_path / "bag")


@pytest.mark.slow
def test_a_foreign_frame_and_a_changed_image_size_are_one_sentence(tmp_path):
    realtime(tmp_path / "frame", 0.5, frame="base_link")
    with pytest.raises(SequenceError, match="frame: PSM1/body/servo_cf: unknown frame 'base_link'"):
        read_episode(tmp_path / "frame")
    with Recording(tmp_path / "size") as recording:
        for number in range(6):
            recording.act(STEP * number, number)
            recording.observe(STEP * number, number, leave_out=(messages.RENDERED_IMAGE,))
            image = np.zeros((HEIGHT, WIDTH if number < 3 else 64, 3), np.uint8)
            stamp = BEGIN + STEP * number
            message = messages.encode_image(image, stamp, "camera", recording.types)
            recording.write([(messages.RENDERED_IMAGE, message)])
    with pytest.raises(SequenceError, match="size: rendered images change from 96×80 to 64×80"):
        export_lerobot([tmp_path / "size"], tmp_path / "out", "t")
    assert not (tmp_path / "out").exists()


def test_the_arm_of_the_camera_is_no_tool():
    recorded = {f"/{make(arm).name}": make(arm).type for arm in ("ECM", "PSM2") for make in (messages.tool_pose, messages.tool_reaction)}
    assert _arms(recorded) == ("PSM2",)
