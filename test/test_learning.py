"""From a running graph to a dataset: recordings that survive, episodes that pair what belongs together, LeRobot's layout."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from conftest import wait_until

from endo_sim_ros import messages
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning import lerobot
from endo_sim_ros.learning.episodes import (
    JAW_OPEN,
    NEAREST,
    action_names,
    environment_names,
    read_episode,
    state_names,
    summarize_tissue,
)
from endo_sim_ros.learning.lerobot import IMAGE, export_lerobot
from endo_sim_ros.messages import ControlNodeCloud, bag_types
from endo_sim_ros.sequences.bag import BagReader, BagWriter

ROOT = Path(__file__).parents[1]
S = 1_000_000_000
STEP = S // 25
BEGIN = 1000 * S
WIDTH, HEIGHT = 96, 80
TURNED = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # a quarter turn about z


# ----------------------------------------------------------------------------------------------------- made recordings


def picture(number):
    """An image that tells its number in its brightness."""
    image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    image[..., 0] = 2 * number % 256
    image[:, : WIDTH // 2, 1] = 200
    return image


REST = np.stack(np.meshgrid(*[np.linspace(-0.02, 0.02, 4)] * 2, [0.1], indexing="ij"), -1).reshape(-1, 3).astype(np.float32)


def nodes(number):
    """Control nodes that moved by a tenth of a millimetre per number along x; one of them twice as far."""
    moved = np.zeros_like(REST)
    moved[:, 0] = 1e-4 * number
    moved[3, 0] *= 2
    return ControlNodeCloud(REST, REST + moved, np.tile(np.eye(3, dtype=np.float32), (len(REST), 1, 1)), S)


def tip(number, arm="PSM1"):
    pose = TURNED.copy()
    pose[:3, 3] = (0.001 * number, 0.01 if arm == "PSM1" else -0.01, 0.1)
    return pose


class Recording:
    """Writes messages of a graph; times in nanoseconds since the beginning."""

    def __init__(self, path):
        self.bag, self.types, self.clock = BagWriter(path), bag_types(), 7 * S

    def __enter__(self):
        self.bag.__enter__()
        return self

    def __exit__(self, *error):
        self.bag.__exit__(*error)

    def observe(self, time_ns, number, arms=("PSM1",), leave_out=()):
        """What the graph says in a step."""
        stamp = BEGIN + time_ns
        said = [
            (messages.CONTROL_NODES, messages.encode_control_nodes(nodes(number), stamp, "world", self.types)),
            (messages.RENDERED_IMAGE, messages.encode_image(picture(number), stamp, "camera", self.types)),
        ]
        for arm in arms:
            reaction = messages.encode_wrench((number, 0, 0), (0, 0, number), stamp, arm, self.types)  # in axes of the tip
            said.append((messages.tool_reaction(arm), reaction))
        self.write(said, leave_out)

    def act(self, time_ns, number, arms=("PSM1",), leave_out=(), frame="world", base=None):
        """What a policy says; poses in the world, or in the frame of a robot's base with its pose in the world."""
        stamp = BEGIN + time_ns
        name, pose_of_base = base or ("world", np.eye(4))
        said = []
        for arm in arms:
            pose = np.linalg.inv(pose_of_base) @ tip(number, arm)
            said.append((messages.tool_pose(arm), messages.encode_pose(pose, stamp, name, self.types)))
            wrench = messages.encode_wrench((0, 0, -number), (0, number, 0), stamp, frame, self.types)
            said.append((messages.tool_wrench(arm), wrench))
            said.append((messages.tool_jaw(arm), messages.encode_jaw(0.01 * number, stamp, self.types)))
        self.write(said, leave_out)

    def write(self, said, leave_out=()):
        for topic, message in said:
            if topic not in leave_out:
                self.clock += S // 1000  # when it was recorded means nothing
                self.bag.write(topic, message, self.clock)


def lockstep(path, steps=12, missing=(), step=STEP, **options):
    """A first observation, then commands with the observations that they lead to, with equal stamps."""
    with Recording(path) as recording:
        recording.act(0, 0, **options)
        recording.observe(0, 0)
        for number in range(1, steps):
            if number not in missing:
                recording.act(step * number, number, **options)
                recording.observe(step * number, number)
    return path


def realtime(path, seconds=2.0, leave_out=(), arms=("PSM1",), **options):
    """Observations at 25 Hz, commands at 100 Hz, out of phase; both count up from 0 at 0 s."""
    with Recording(path) as recording:
        for tick in range(int(seconds * 100)):
            recording.act(tick * S // 100 + 1_000_000, tick, arms, leave_out, **options)
            if tick % 4 == 0:
                recording.observe(tick * S // 100 + 3_000_000, tick // 4, arms, leave_out)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return realtime(tmp_path_factory.mktemp("recordings") / "realtime")


@pytest.fixture(scope="module")
def two_arms(tmp_path_factory):
    return realtime(tmp_path_factory.mktemp("recordings") / "two", arms=("PSM1", "PSM2"))


def column(episode, name):
    for names, values in (
        (state_names, episode.state), (action_names, episode.action), (environment_names, episode.environment_state),
    ):  # fmt: skip
        if name in names(episode.arms):
            return values[:, names(episode.arms).index(name)]
    raise KeyError(name)


# ------------------------------------------------------------------------------------------------------------- episodes


def test_steps_in_lockstep_are_paired_by_their_stamps(tmp_path):
    episode = read_episode(lockstep(tmp_path / "bag"))
    assert episode.lockstep and episode.fps == 25 and len(episode) == 11 and episode.arms == ("PSM1",)
    observed = np.arange(11)
    np.testing.assert_array_equal(episode.image_numbers, observed)
    np.testing.assert_allclose(column(episode, "mean_displacement_x"), 1e-4 * observed * 17 / 16, atol=1e-8)
    np.testing.assert_allclose(column(episode, "PSM1.x"), 1e-3 * observed, atol=1e-8)
    # the action of a row made the observation of the next
    np.testing.assert_allclose(episode.action[:, 0], 1e-3 * (observed + 1), atol=1e-8)
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), -(observed + 1.0))
    np.testing.assert_allclose(column(episode, "PSM1.torque_y"), observed + 1.0)
    np.testing.assert_allclose(episode.action[:, 7], 0.01 * (observed + 1), atol=1e-7)


def test_the_first_observation_needs_no_command(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        recording.act(-S, 0)  # once before the steps begin, as to say where the tool is
        for number in range(5):
            if number:
                recording.act(STEP * number, number)
            recording.observe(STEP * number, number)
    episode = read_episode(tmp_path / "bag")
    assert episode.lockstep and len(episode) == 4
    np.testing.assert_array_equal(episode.image_numbers, [0, 1, 2, 3])
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), [-1, -2, -3, -4])


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
    assert episode.lockstep and len(episode) == 38 + early and not caplog.text
    np.testing.assert_array_equal(episode.image_numbers, np.arange(0 if early else 1, 39))
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), -np.arange(1.0 if early else 2.0, 40))


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
    np.testing.assert_array_equal(episode.image_numbers, observed)
    np.testing.assert_allclose(column(episode, "PSM1.x"), 1e-3 * 4 * observed, atol=1e-8)  # tick 4k came at 0.04 k + 0.001
    np.testing.assert_allclose(column(episode, "PSM1.force_z"), -4.0 * (observed + 1))


def test_another_rate_repeats_or_skips(bag):
    fast, slow = read_episode(bag, fps=50), read_episode(bag, fps=5)
    np.testing.assert_array_equal(fast.image_numbers, np.arange(98) // 2)
    np.testing.assert_array_equal(slow.image_numbers, np.arange(len(slow)) * 5)
    np.testing.assert_allclose(column(slow, "PSM1.force_z"), -20.0 * (np.arange(len(slow)) + 1))


def test_lockstep_recordings_can_be_sampled_at_a_rate(tmp_path):
    path = lockstep(tmp_path / "bag")
    assert read_episode(path, sampling="rate").lockstep is False
    ten = read_episode(path, fps=10)
    assert not ten.lockstep and ten.fps == 10
    assert read_episode(path, fps=25).lockstep
    with pytest.raises(SequenceError, match="its steps are 25 per second, not 10"):
        read_episode(path, fps=10, sampling="lockstep")


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


@pytest.mark.parametrize("name", ["PSM1_base", ""])
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


def test_poses_without_a_frame_are_in_the_world_when_the_base_is_not_named(bag, tmp_path):
    episode = read_episode(realtime(tmp_path / "bag", base=("", np.eye(4))))
    np.testing.assert_array_equal(episode.state, read_episode(bag).state)


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


def test_two_arms_have_columns_of_their_own(two_arms):
    both, second = read_episode(two_arms), read_episode(two_arms, arms=("PSM2",))
    assert both.arms == ("PSM1", "PSM2") and both.state.shape[1] == both.action.shape[1] == 28
    assert len(state_names(both.arms)) == 28 == len(set(action_names(both.arms)))
    assert both.environment_state.shape[1] == 16 == len(set(environment_names(both.arms)))
    np.testing.assert_array_equal(both.state[:, 14:], second.state)
    np.testing.assert_allclose(column(both, "PSM2.y"), -0.01, atol=1e-8)
    np.testing.assert_array_equal(both.environment_state[:, 10:], second.environment_state[:, 4:])


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


def test_images_are_those_of_their_rows(bag):
    episode = read_episode(bag, fps=50)
    shown = [image[0, 0, 0] // 2 for image in episode.images()]
    np.testing.assert_array_equal(shown, episode.image_numbers)


# --------------------------------------------------------------------------------------------------------- bad recordings


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


# ---------------------------------------------------------------------------------------------------------------- layout


def read_tables(root, pattern):
    import pyarrow.parquet as pq

    return [pq.read_table(path) for path in sorted(root.glob(pattern))]


@pytest.fixture(scope="module")
def dataset(bag, tmp_path_factory):
    """Two episodes of different length, as video."""
    longer = realtime(tmp_path_factory.mktemp("recordings") / "longer", 3.0)
    out = tmp_path_factory.mktemp("datasets") / "video"
    assert export_lerobot([bag, longer], out, "pull the tissue") == (2, 49 + 74)
    return out


def test_the_layout_is_that_of_lerobot(dataset):
    info = json.loads((dataset / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 25 and info["splits"] == {"train": "0:2"}
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 123, 1)
    features = info["features"]
    assert features[IMAGE]["dtype"] == "video" and features[IMAGE]["shape"] == [HEIGHT, WIDTH, 3]
    for key, names in (
        ("observation.state", state_names), ("action", action_names), ("observation.environment_state", environment_names),
    ):  # fmt: skip
        assert features[key] == {"dtype": "float32", "shape": [len(names(("PSM1",)))], "names": names(("PSM1",))}
    for number, length in ((0, 49), (1, 74)):
        place = {"chunk_index": 0, "file_index": number}
        (table,) = read_tables(dataset, info["data_path"].format(**place))
        assert set(table.column_names) == set(features) - {IMAGE} and table.num_rows == length
        assert table.column("frame_index").to_pylist() == list(range(length))
        assert table.column("index").to_pylist() == list(range(number * 49, number * 49 + length))
        assert set(table.column("episode_index").to_pylist()) == {number}
        np.testing.assert_allclose(table.column("timestamp").to_numpy(), np.arange(length) / 25, atol=1e-5)
        for key, feature in features.items():
            if key != IMAGE:
                kind = str(table.schema.field(key).type).replace("fixed_size_list<element: ", "").replace("float", "float32")
                assert feature["dtype"].replace("float32", "float") in kind.replace("float32", "float"), (key, kind)
        video = dataset / info["video_path"].format(video_key=IMAGE, **place)
        with av.open(str(video)) as container:
            shown = list(container.decode(video=0))
        assert len(shown) == length
        np.testing.assert_allclose([frame.time for frame in shown], np.arange(length) / 25, atol=1e-6)
        brightness = [frame.to_ndarray(format="rgb24")[..., 0].mean() for frame in shown]
        np.testing.assert_allclose(brightness, [2 * n % 256 for n in range(length)], atol=4)


def test_episodes_and_tasks_are_described(dataset):
    (episodes,) = read_tables(dataset, "meta/episodes/*/*.parquet")
    rows = episodes.to_pylist()
    assert [row["length"] for row in rows] == [49, 74]
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows] == [(0, 49), (49, 123)]
    assert [row["data/file_index"] for row in rows] == [row[f"videos/{IMAGE}/file_index"] for row in rows] == [0, 1]
    assert rows[1]["tasks"] == ["pull the tissue"] and rows[1][f"videos/{IMAGE}/to_timestamp"] == pytest.approx(74 / 25)
    (tasks,) = read_tables(dataset, "meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "__index_level_0__": "pull the tissue"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


def test_statistics_are_those_of_the_data(dataset):
    statistics = json.loads((dataset / "meta/stats.json").read_text())
    tables = read_tables(dataset, "data/*/*.parquet")
    for key in ("action", "observation.state", "observation.environment_state"):
        values = np.vstack([np.array(table.column(key).to_pylist()) for table in tables])
        for name, expected in (
            ("min", values.min(0)), ("max", values.max(0)), ("mean", values.mean(0)), ("std", values.std(0)),
            ("q50", np.median(values, 0)), ("q99", np.quantile(values, 0.99, axis=0)), ("count", [123]),
        ):  # fmt: skip
            np.testing.assert_allclose(statistics[key][name], expected, rtol=1e-6, atol=1e-9, err_msg=f"{key} {name}")
    pixels = np.stack([picture(number) for length in (49, 74) for number in range(length)]) / 255
    for name in ("min", "max", "mean", "std"):
        expected = getattr(pixels, name)((0, 1, 2)).reshape(3, 1, 1)
        np.testing.assert_allclose(statistics[IMAGE][name], expected, atol=1e-6)


def test_png_images_are_exact(bag, tmp_path):
    export_lerobot([bag], tmp_path / "out", "t", images="png")
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["features"][IMAGE]["dtype"] == "image" and info["video_path"] is None
    assert not (tmp_path / "out/videos").exists()
    (table,) = read_tables(tmp_path / "out", "data/*/*.parquet")
    for number, cell in enumerate(table.column(IMAGE).to_pylist()):
        image = cv2.imdecode(np.frombuffer(cell["bytes"], np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), picture(number))


def test_episodes_that_do_not_agree_are_refused_before_anything_is_written(bag, two_arms, tmp_path):
    steps = lockstep(tmp_path / "steps", step=S // 10)
    with pytest.raises(SequenceError, match=r"two has arms \('PSM1', 'PSM2'\), .*realtime \('PSM1',\); .* must agree"):
        export_lerobot([bag, two_arms], tmp_path / "out", "t")
    with pytest.raises(SequenceError, match="steps has fps 10, .*realtime 25; the episodes of one dataset must agree"):
        export_lerobot([bag, steps], tmp_path / "out", "t")
    assert export_lerobot([bag, two_arms], tmp_path / "out", "t", arms=("PSM1",))[0] == 2


def test_a_dataset_is_not_overwritten_nor_left_in_halves(bag, dataset, tmp_path, monkeypatch):
    with pytest.raises(SequenceError, match="video exists already; choose another name"):
        export_lerobot([bag], dataset, "t")
    with pytest.raises(SequenceError, match="no recording to export"):
        export_lerobot([], tmp_path / "out", "t")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(lerobot, "_write_video", full)
    with pytest.raises(OSError):
        export_lerobot([bag], tmp_path / "out", "t")
    assert not (tmp_path / "out").exists()


def test_odd_images_make_no_video(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        for number in range(4):
            recording.act(STEP * number, number)
            recording.observe(STEP * number, number, leave_out=(messages.RENDERED_IMAGE,))
            stamp = BEGIN + STEP * number
            message = messages.encode_image(picture(number)[:, 1:], stamp, "camera", recording.types)
            recording.write([(messages.RENDERED_IMAGE, message)])
    with pytest.raises(SequenceError, match="95×80 images make no video, which needs even sides; export them as png"):
        export_lerobot([tmp_path / "bag"], tmp_path / "out", "t")
    assert export_lerobot([tmp_path / "bag"], tmp_path / "out", "t", images="png") == (1, 3)


def test_without_pyarrow_it_is_said_what_to_install(bag, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(RuntimeError, match=r"needs pyarrow, which is not installed; pip install 'endo_sim_ros\[lerobot\]'"):
        export_lerobot([bag], tmp_path / "out", "t")


@pytest.mark.parametrize("images", ["video", "png"])
def test_lerobot_itself_reads_the_dataset(bag, tmp_path, images, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    loader = pytest.importorskip(
        "lerobot.datasets.lerobot_dataset", reason="lerobot is not installed; it wants other versions of torch and numpy"
    )
    export_lerobot([bag, bag], tmp_path / "out", "pull", images=images)
    data = loader.LeRobotDataset("local/out", root=tmp_path / "out", video_backend="pyav")
    assert data.num_episodes == 2 and len(data) == 98 and data.fps == 25
    episode = read_episode(bag)
    for index in (0, 20, 48, 49, 97):
        item, row = data[index], index % 49
        assert item["task"] == "pull" and item["episode_index"] == index // 49 and item["frame_index"] == row
        np.testing.assert_array_equal(item["observation.state"], episode.state[row])
        np.testing.assert_array_equal(item["observation.environment_state"], episode.environment_state[row])
        np.testing.assert_array_equal(item["action"], episode.action[row])
        assert item[IMAGE].shape == (3, HEIGHT, WIDTH)
        np.testing.assert_allclose(255 * item[IMAGE].permute(1, 2, 0), picture(row), atol=0.01 if images == "png" else 12)
    times = {IMAGE: [-1 / 25, 0.0], "action": [0.0, 1 / 25, 2 / 25]}
    data = loader.LeRobotDataset("local/out", root=tmp_path / "out", delta_timestamps=times, video_backend="pyav")
    item = data[48]
    assert item[IMAGE].shape == (2, 3, HEIGHT, WIDTH) and item["action_is_pad"].tolist() == [False, True, True]
    only = loader.LeRobotDataset("local/out", root=tmp_path / "out", episodes=[1], video_backend="pyav")
    assert len(only) == 49 and only[0]["index"] == 49


# ---------------------------------------------------------------------------------------------------------- command line


def endo_sim(*arguments, timeout=120):
    command = [sys.executable, "-m", "endo_sim_ros.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout)


def test_export_is_a_command(bag, tmp_path):
    out = tmp_path / "out"
    done = endo_sim("export", bag, bag, out, "--format", "lerobot", "--fps", 10, "--arm", "PSM1", "--task", "pull it")
    assert done.returncode == 0, done.stderr
    assert f"{out}: 2 episodes, 38 frames" in done.stdout
    assert json.loads((out / "meta/info.json").read_text())["fps"] == 10


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (("export", "no_bag", "OUT"), "no_bag: no such bag"),
        (("export", "no_bag"), "give one recording or more, then the folder of the dataset"),
        (("record", "README.md"), "README.md exists already"),
        (("record", "OUT", "--topics", "rendered/image"), "topics: the contract has no 'rendered/image' for the arms PSM1"),
        (("record", "OUT", "--arms", "PSM 1"), "arms: 'PSM 1' cannot name topics"),
    ],
)
def test_mistakes_are_one_sentence(arguments, sentence, tmp_path):
    done = endo_sim(*(tmp_path / "out" if word == "OUT" else word for word in arguments))
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert sentence in done.stderr and len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------------------------------- recording


class Graph:
    """A graph that says something on three topics, and hears what the recorder says about itself."""

    def __init__(self, namespace=""):
        import rclpy

        from endo_sim_ros.nodes.base import EndoNode

        rclpy.init(args=["--ros-args", "-r", f"__ns:=/{namespace}"])
        self.node = EndoNode("graph")
        self.executor = rclpy.executors.SingleThreadedExecutor()
        self.executor.add_node(self.node)
        topics = (messages.RENDERED_IMAGE, messages.tool_pose("PSM1"), messages.tool_wrench("PSM2"))
        self.publishers = {topic: self.node.publisher(topic) for topic in topics}
        self.statuses, self.sent = [], []
        self.node.subscribe(messages.DIAGNOSTICS, self._on_diagnostics)

    def _on_diagnostics(self, message):
        self.statuses += [status for status in messages.decode_diagnostics(message) if status[0] == "recorder"]

    def heard(self):
        """Whether somebody listens to all that is said."""
        return all(publisher.get_subscription_count() for publisher in self.publishers.values())

    def say(self):
        """One message on each topic; the image does not compress."""
        stamp = time.time_ns()
        pixels = np.random.default_rng(stamp).integers(0, 256, (80, 100, 3), np.uint8)
        image, pose, wrench = self.publishers.values()
        image.publish(messages.encode_image(pixels, stamp, "camera"))
        pose.publish(messages.encode_pose(np.eye(4), stamp, "world"))
        wrench.publish(messages.encode_wrench((1, 2, 3), (0, 0, 0), stamp, "world"))
        self.sent.append(stamp)
        self.step()

    def step(self):
        self.executor.spin_once(timeout_sec=0.01)

    def close(self):
        import rclpy

        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture
def graph(request):
    """Its parameter, if there is one, is the namespace."""
    pytest.importorskip("rclpy", reason="recording needs rclpy")
    graph = Graph(getattr(request, "param", ""))
    yield graph
    graph.close()


def start(*arguments, **options):
    command = [sys.executable, "-m", *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options)


def read_stamps(path, topic):
    with BagReader(path) as bag:
        return [messages.stamp_to_ns(message.header.stamp) for _, _, message in bag.messages([topic])]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda number: number.name)
def test_what_was_recorded_outlives_the_recorder(graph, tmp_path, number):
    path = tmp_path / "my récording"  # a name that must be quoted
    recorder = start("endo_sim_ros.cli", "record", path, "--arms", "PSM1", "PSM2")
    try:
        wait_until(graph.heard, 30, "the recorder", graph.step)
        begin = time.monotonic() + 1.5  # each side of a topic finds the other in its own time
        while time.monotonic() < begin:
            graph.say()
        began = len(graph.sent)
        end = time.monotonic() + 3.0
        while time.monotonic() < end:
            graph.say()
        if number != signal.SIGKILL:  # these end a recorder that hears all; a kill may lose the last second
            settled = time.monotonic() + 0.5
            wait_until(lambda: time.monotonic() > settled, 5, "the last message to arrive", graph.step)
    finally:
        recorder.send_signal(number)
        output, _ = recorder.communicate(timeout=30)
    sent = np.array(graph.sent[began:])
    for topic in graph.publishers:
        kept = np.array(read_stamps(path, topic))
        lost = sent[~np.isin(sent, kept)]
        if number == signal.SIGKILL:
            assert len(kept) > 20 and (lost > sent[-1] - 2.2 * S).all(), topic.name
        else:
            assert len(lost) == 0 and recorder.returncode == 0, (topic.name, output)
    assert (path / "metadata.yaml").exists() == (number != signal.SIGKILL)
    if number != signal.SIGKILL:
        assert "messages of" in output and "my récording" in output and "Traceback" not in output, output


def test_chosen_topics_alone_are_recorded_with_canonical_bytes(graph, tmp_path):
    recorder = start("endo_sim_ros.cli", "record", tmp_path / "bag", "--topics", "/PSM1/measured_cp", "rendered/image_raw")
    try:
        image = graph.publishers[messages.RENDERED_IMAGE]
        wait_until(image.get_subscription_count, 30, "the recorder", graph.step)
        until = time.monotonic() + 1.5
        while time.monotonic() < until:
            graph.say()
    finally:
        recorder.send_signal(signal.SIGINT)
        recorder.communicate(timeout=30)
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) == {"/rendered/image_raw", "/PSM1/measured_cp"}
        for raw in bag.raw_messages():
            typestore = bag_types().typestore
            again = typestore.serialize_cdr(typestore.deserialize_cdr(raw.data, raw.type), raw.type)
            assert bytes(again) == bytes(raw.data)


@pytest.mark.parametrize("graph", ["left"], indirect=True)
def test_a_graph_in_a_namespace_is_recorded_under_the_names_without_it(graph, tmp_path):
    other = graph.node.publisher(messages.tool_pose("PSM1")._replace(name="/PSM1/measured_cp"))  # a graph without a namespace
    arguments = ("--arms", "PSM1", "PSM2", "--namespace", "/left/")
    recorder = start("endo_sim_ros.cli", "record", tmp_path / "bag", *arguments)
    try:
        wait_until(graph.heard, 30, "the recorder", graph.step)
        begin = time.monotonic() + 1.5  # each side of a topic finds the other in its own time
        while time.monotonic() < begin:
            graph.say()
        began = len(graph.sent)
        for _ in range(20):
            graph.say()
            other.publish(messages.encode_pose(np.eye(4), 7, "world"))
        settled = time.monotonic() + 1.0
        wait_until(lambda: time.monotonic() > settled, 5, "the last message to arrive", graph.step)
    finally:
        recorder.send_signal(signal.SIGINT)
        output, _ = recorder.communicate(timeout=30)
    assert recorder.returncode == 0 and "Traceback" not in output, output
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) >= {f"/{topic.name}" for topic in graph.publishers}
        assert not any("left" in name for name in bag.topics)
    for topic in graph.publishers:
        kept = read_stamps(tmp_path / "bag", topic)
        assert set(graph.sent[began:]) <= set(kept) and 7 not in kept, topic.name


@pytest.fixture(params=["small disk", "limit"])
def full_disk(request, tmp_path):
    """A folder with room for two megabytes, and how to start a process that meets its end."""
    if request.param == "limit":
        size = 2_000_000
        yield tmp_path, {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))}, "File too large"
        return
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", disk]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("a small disk can be mounted by root only")
    try:
        yield disk, {}, "No space left on device"
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_recorder_on_a_full_disk_says_so_lives_on_and_keeps_what_it_wrote(graph, full_disk):
    disk, options, reason = full_disk
    parameters = ("-p", f"bag:={disk / 'bag'}", "-p", "arms:=[PSM1, PSM2]")
    recorder = start("endo_sim_ros.nodes.recorder_node", "--ros-args", *parameters, **options)
    try:
        wait_until(graph.heard, 30, "the recorder", graph.step)
        failed = lambda: [status for status in graph.statuses if status[1] == messages.ERROR]  # noqa: E731
        wait_until(failed, 30, "the disk to be full", graph.say)
        sentence = failed()[0][2]
        assert sentence.startswith("recording stopped: ") and reason in sentence and "\n" not in sentence
        assert sentence.endswith("what was written before can be read")
        graph.statuses.clear()
        wait_until(lambda: len(failed()) > 1, 10, "the recorder to go on telling it", graph.say)
        assert recorder.poll() is None
    finally:
        recorder.send_signal(signal.SIGINT)
        output, _ = recorder.communicate(timeout=30)
    assert recorder.returncode == 0 and "Traceback" not in output, output
    kept = read_stamps(disk / "bag", messages.RENDERED_IMAGE)
    assert len(kept) > 30  # 24 kB each
    first = graph.sent.index(kept[0])  # each side of a topic finds the other in its own time
    assert kept == graph.sent[first : first + len(kept)]  # none missing before the last chunk


def test_record_on_a_full_disk_ends_with_the_sentence(graph, tmp_path):
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, 1_500_000))  # noqa: E731
    recorder = start("endo_sim_ros.cli", "record", tmp_path / "bag", "--arms", "PSM1", "PSM2", preexec_fn=limit)
    try:
        wait_until(graph.heard, 30, "the recorder", graph.step)
        wait_until(lambda: recorder.poll() is not None, 30, "the recorder to end", graph.say)
    finally:
        recorder.kill()
        output, _ = recorder.communicate(timeout=30)
    assert recorder.returncode == 1 and "endo-sim: recording stopped: " in output and "Traceback" not in output, output
    assert len(read_stamps(tmp_path / "bag", messages.RENDERED_IMAGE)) > 15  # 24 kB each; a chunk of 1 MB may be lost
