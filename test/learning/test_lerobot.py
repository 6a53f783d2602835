"""Datasets in LeRobot's layout, and the command that exports them."""

import json
import sys

import av
import cv2
import numpy as np
import pytest
from endo_sim_command import endo_sim, endo_sim_here
from made_recordings import BEGIN, HEIGHT, STEP, WIDTH, Recording, joints, labels, lockstep, picture, realtime
from thorough import mostly_thorough

from endo_sim_ros import messages
from endo_sim_ros.core import drawing
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.episodes import action_names, environment_names, read_episode, state_names
from endo_sim_ros.learning.lerobot import CAMERA_POSE, GOAL, IMAGE, IMAGE_RIGHT, JOINT_POSITIONS, SEGMENTATION, export_lerobot

S = 1_000_000_000


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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_png_images_are_exact(bag, tmp_path):
    export_lerobot([bag], tmp_path / "out", "t", images="png")
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["features"][IMAGE]["dtype"] == "image" and info["video_path"] is None
    assert not (tmp_path / "out/videos").exists()
    (table,) = read_tables(tmp_path / "out", "data/*/*.parquet")
    for number, cell in enumerate(table.column(IMAGE).to_pylist()):
        image = cv2.imdecode(np.frombuffer(cell["bytes"], np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), picture(number))


@pytest.mark.slow
def test_recordings_with_raw_and_with_compressed_images_make_one_dataset(bag, tmp_path):
    export_lerobot([bag, lockstep(tmp_path / "jpeg", compressed=True)], tmp_path / "out", "t", fps=25, images="png")
    tables = read_tables(tmp_path / "out", "data/*/*.parquet")
    cell = tables[1].column(IMAGE).to_pylist()[3]
    image = cv2.cvtColor(cv2.imdecode(np.frombuffer(cell["bytes"], np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert len(tables) == 2 and 0 < np.abs(image.astype(int) - picture(3)).mean() < 3


@pytest.mark.slow
@pytest.mark.parametrize("compressed, images", mostly_thorough([(True, "video"), (False, "png"), (False, "video"), (True, "png")], 2))
def test_joints_both_eyes_labels_and_the_camera_are_exported(images, compressed, tmp_path):
    bag = lockstep(tmp_path / "bag", compressed=compressed, everything=True)
    assert export_lerobot([bag, bag], tmp_path / "out", "t", images=images) == (2, 22)
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    features = info["features"]
    assert features[JOINT_POSITIONS]["names"] == [
        f"PSM1.{name}" for name in ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
    ]
    assert features[CAMERA_POSE] == {"dtype": "float32", "shape": [7], "names": ["x", "y", "z", "qx", "qy", "qz", "qw"]}
    assert features[SEGMENTATION]["dtype"] == "image" and features[SEGMENTATION]["shape"] == [HEIGHT, WIDTH, 1]
    assert features[IMAGE_RIGHT] == features[IMAGE] and features[IMAGE]["dtype"] == ("image" if images == "png" else "video")
    statistics = json.loads((tmp_path / "out/meta/stats.json").read_text())
    assert set(statistics) == set(features) and np.shape(statistics[SEGMENTATION]["mean"]) == (1, 1, 1)
    for number, table in enumerate(read_tables(tmp_path / "out", "data/*/*.parquet")):
        np.testing.assert_allclose(table.column(JOINT_POSITIONS).to_pylist(), [joints(k) for k in range(11)], atol=1e-6)
        np.testing.assert_allclose(np.array(table.column(CAMERA_POSE).to_pylist())[:, 0], 1e-3 * np.arange(11), atol=1e-7)
        np.testing.assert_allclose(np.array(table.column("observation.state").to_pylist())[1:, 7], 0.01 * np.arange(1, 11), atol=1e-7)
        # What the action of a row led to is said with the next row.
        assert table.column("next.reward").to_pylist() == [0.5 * k for k in range(1, 12)]
        assert table.column("next.done").to_pylist() == [False] * 10 + [True] == table.column("next.success").to_pylist()
        assert set(table.column("seed").to_pylist()) == {7} and table.column(GOAL).to_pylist() == [[1, 2, 3]] * 11
        for k, cell in enumerate(table.column(SEGMENTATION).to_pylist()):
            np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(cell["bytes"], np.uint8), cv2.IMREAD_UNCHANGED), labels(k))
        for key, flip in ((IMAGE, 1), (IMAGE_RIGHT, -1)):
            if images == "png":
                cells = [np.frombuffer(cell["bytes"], np.uint8) for cell in table.column(key).to_pylist()]
                shown = [cv2.imdecode(cell, cv2.IMREAD_COLOR)[..., ::-1] for cell in cells]
            else:
                place = {"chunk_index": 0, "file_index": number}
                with av.open(str(tmp_path / "out" / info["video_path"].format(video_key=key, **place))) as container:
                    shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
            assert len(shown) == 11
            for k, image in enumerate(shown):
                exact = images == "png" and not compressed
                assert np.abs(image.astype(int) - picture(k)[:, ::flip]).mean() <= (0 if exact else 4)


@pytest.mark.slow
def test_episodes_that_do_not_agree_are_refused_before_anything_is_written(bag, two_arms, tmp_path):
    steps = lockstep(tmp_path / "steps", step=S // 10)
    with pytest.raises(SequenceError, match=r"two has arms \('PSM1', 'PSM2'\), .*realtime \('PSM1',\); .* must agree"):
        export_lerobot([bag, two_arms], tmp_path / "out", "t")
    with pytest.raises(SequenceError, match="steps has fps 10, .*realtime 25; the episodes of one dataset must agree"):
        export_lerobot([bag, steps], tmp_path / "out", "t")
    both = lockstep(tmp_path / "both", everything=True)
    with pytest.raises(SequenceError, match="both has beside the rest right, segmentation, joints, camera_pose, .* nothing; the epis"):
        export_lerobot([lockstep(tmp_path / "plain"), both], tmp_path / "out", "t")
    assert export_lerobot([bag, two_arms], tmp_path / "out", "t", arms=("PSM1",))[0] == 2


@pytest.mark.slow
def test_a_dataset_is_not_overwritten_nor_left_in_halves(bag, dataset, tmp_path, monkeypatch):
    with pytest.raises(SequenceError, match="video exists already; choose another name"):
        export_lerobot([bag], dataset, "t")
    with pytest.raises(SequenceError, match="no recording to export"):
        export_lerobot([], tmp_path / "out", "t")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(drawing, "write_video", full)
    with pytest.raises(OSError):
        export_lerobot([bag], tmp_path / "out", "t")
    monkeypatch.setattr("pyarrow.parquet.ParquetWriter.write_table", full)
    with pytest.raises(OSError, match="out/data/chunk-000/file-000.parquet"):
        export_lerobot([bag], tmp_path / "out", "t", images="png")
    assert not (tmp_path / "out").exists()


def odd_picture(number, types):
    return messages.RENDERED_IMAGE, messages.encode_image(picture(number)[:, 1:], BEGIN + STEP * number, "camera", types)


@pytest.mark.slow
def test_odd_images_make_no_video(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        for number in range(4):
            recording.act(STEP * number, number)
            recording.observe(STEP * number, number, leave_out=(messages.RENDERED_IMAGE,))
            recording.write([odd_picture(number, recording.types)])
    with pytest.raises(SequenceError, match="95×80 images make no video, which needs even sides; choose --images png, or another width"):
        export_lerobot([tmp_path / "bag"], tmp_path / "out", "t")
    assert export_lerobot([tmp_path / "bag"], tmp_path / "out", "t", images="png") == (1, 3)


def test_odd_images_are_told_before_anything_else_is_read(tmp_path):
    with Recording(tmp_path / "bag") as recording:
        recording.write([odd_picture(0, recording.types)])
    with pytest.raises(SequenceError, match="95×80 images make no video"):
        export_lerobot([tmp_path / "bag"], tmp_path / "out", "t")
    with pytest.raises(SequenceError, match="control_nodes"):
        export_lerobot([tmp_path / "bag"], tmp_path / "out", "t", images="png")


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


@pytest.mark.parametrize("images", ["video", "png"])
def test_lerobot_itself_reads_both_eyes_labels_joints_and_the_camera(tmp_path, images, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    loader = pytest.importorskip(
        "lerobot.datasets.lerobot_dataset", reason="lerobot is not installed; it wants other versions of torch and numpy"
    )
    export_lerobot([lockstep(tmp_path / "bag", everything=True)], tmp_path / "out", "pull", images=images)
    data = loader.LeRobotDataset("local/out", root=tmp_path / "out", video_backend="pyav")
    item = data[5]
    assert item[IMAGE_RIGHT].shape == (3, HEIGHT, WIDTH) and item[SEGMENTATION].shape == (1, HEIGHT, WIDTH)
    np.testing.assert_array_equal(np.round(255 * item[SEGMENTATION][0].numpy()), labels(5))
    np.testing.assert_allclose(item[JOINT_POSITIONS], joints(5), atol=1e-6)
    assert item[CAMERA_POSE].shape == (7,)


@pytest.mark.dds
def test_export_is_a_command(bag, tmp_path):
    out = tmp_path / "out"
    done = endo_sim_here("export", bag, bag, out, "--format", "lerobot", "--fps", 10, "--arms", "PSM1", "--task", "pull it")
    assert done.returncode == 0, done.stderr
    assert f"{out}: 2 episodes, 38 frames" in done.stdout
    assert json.loads((out / "meta/info.json").read_text())["fps"] == 10


@pytest.mark.dds
@pytest.mark.parametrize(
    "arguments, sentence",
    mostly_thorough(
        [
            (("export", "no_bag", "OUT"), "no_bag: no such bag"),
            (("export", "no_bag"), "give one recording or more, then the folder of the dataset"),
            (("record", "README.md"), "README.md exists already"),
            (("record", "OUT", "--topics", "rendered/image"), "topics: the contract has no 'rendered/image' for the arms PSM1"),
            (("record", "OUT", "--arms", "PSM 1"), "arms: 'PSM 1' cannot name topics"),
            (("record", "OUT", "--namespace", "1st"), "namespace: '1st' cannot name topics; use letters, digits and _, and no digit first"),
        ],
        4,
    ),
)
def test_mistakes_are_one_sentence(arguments, sentence, tmp_path):
    run = endo_sim_here if arguments[0] == "export" else endo_sim  # that records has the signals of its process
    done = run(*(tmp_path / "out" if word == "OUT" else word for word in arguments))
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert sentence in done.stderr and len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert not (tmp_path / "out").exists()
