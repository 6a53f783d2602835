"""Demonstrations by scripted policies, as a dataset that can be continued."""

import errno
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from endo_sim_command import endo_sim_here
from played_tasks import make

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import ModelError
from endo_sim_ros.learning import dataset, demonstrations
from endo_sim_ros.learning.card import _told
from endo_sim_ros.learning.config import DemonstrationConfig, Randomisation, SightConfig
from endo_sim_ros.learning.dataset import IMAGE, IMAGE_RIGHT, SEGMENTATION, DatasetWriter, vector_feature
from endo_sim_ros.learning.demonstrations import Demonstrations, demonstrate
from endo_sim_ros.learning.tasks import TASKS
from endo_sim_ros.physics import MotionConfig

SIGHT = SightConfig(image_width=40, eyes=2, segmentation=True)
NO_ROOM = OSError(errno.ENOSPC, "No space left on device")


def run(out, episodes, noise=0.3, environments=3, task="retraction", **options):
    config = DemonstrationConfig(episodes=episodes, noise=noise, environments=environments, images="png", seed=7)
    return demonstrate(task, ["phantom:0"], out, config, options.pop("sight", SIGHT), device="cpu", **options)


def tables(root):
    return [pq.read_table(path) for path in sorted(root.glob("data/*/*.parquet"))]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Four episodes in one go."""
    out = tmp_path_factory.mktemp("demonstrations") / "whole"
    assert run(out, 4)[0] == 4
    return out


def test_what_was_seen_and_done_solves_the_task(whole):
    info = json.loads((whole / "meta/info.json").read_text())
    assert (info["total_episodes"], info["fps"], info["splits"]) == (4, 25, {"train": "0:4"})
    assert {IMAGE, IMAGE_RIGHT, SEGMENTATION} <= set(info["features"])
    text = (whole / "README.md").read_text()
    assert text == (whole / "meta/README.md").read_text(), "where Open-H asks for it"
    assert "Noise of deviation 0.3 was" in text and "with PROGRASP_FORCEPS |" in text and "| [1] | reward of the action |" in text
    assert "in steps of 2 mm; fourth: above 0 the jaw is closed |" in text and "picture of its right eye |" in text
    assert "0 nothing, 1 tissue, 2 to 6 shaft, wrist, hook (of a tool without jaws), left jaw, right jaw of PSM1 |" in text
    assert "not SI: lengths in 0.02 m or parts of what is wanted" in text and "clipped to ±10 |" in text
    assert "the task draws what it leaves to chance, such as places, starts and goals. Beside that nothing differs" in text
    for table in tables(whole):
        columns = {name: np.array(table.column(name).to_pylist()) for name in table.column_names if name not in (IMAGE, IMAGE_RIGHT)}
        assert columns["next.done"].tolist() == [False] * (len(table) - 1) + [True] == columns["next.success"].tolist()
        assert len(np.unique(columns["seed"])) == 1
        assert set(columns["observation.meta.tool.psm1"]) == {"PROGRASP_FORCEPS"}
        names = info["features"]["observation.environment_state"]["names"]
        moved = columns["observation.environment_state"][:, names.index("spot_moved_z")]
        assert moved[0] == 0 and moved[-1] > 0.8, "the last row is the one before the goal"
        ways = np.linalg.norm(columns["action.cartesian_absolute"][:, :3] - columns["observation.state"][:, :3], axis=1)
        inside = (np.abs(columns["action"][:, :3]) < 1).all(1)
        np.testing.assert_allclose(ways[inside], 0.002 * np.linalg.norm(columns["action"][inside, :3], axis=1), atol=2e-6)


@pytest.mark.slow
def test_without_noise_the_written_actions_lead_to_the_written_states(tmp_path):
    """As played again in a single environment, bit by bit."""
    run(tmp_path / "out", 2, noise=0.0)
    environment = make("retraction")
    for table in tables(tmp_path / "out"):
        columns = {name: np.array(table.column(name).to_pylist(), np.float32) for name in ("observation.environment_state", "action")}
        state, _ = environment.reset(seed=table.column("seed")[0].as_py())
        for row, action in zip(columns["observation.environment_state"], columns["action"]):
            np.testing.assert_allclose(row, state, atol=1e-5)
            state, *_, info = environment.step(action)
        assert info["success"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "error", "kept"),
    [
        pytest.param("_write_files", KeyboardInterrupt(), 3, id="interrupted"),
        pytest.param("_write_files", NO_ROOM, 3, id="full while writing", marks=pytest.mark.thorough),
        pytest.param("_write_table", NO_ROOM, 2, id="full while saving", marks=pytest.mark.thorough),
    ],
)
def test_what_a_run_has_finished_is_kept_and_goes_on_as_one_in_one_go(whole, tmp_path, monkeypatch, caplog, method, error, kept):
    """Whatever the number of environments."""
    out, works = tmp_path / "whole", getattr(DatasetWriter, method)

    def fails(writer, first, *rest, **options):
        if first == 2 or writer.episodes < 4 and first != 3:
            return works(writer, first, *rest, **options)
        (out / "data/chunk-000/file-003.parquet").write_bytes(b"PAR1")
        raise error

    run(out, 2, environments=2)
    monkeypatch.setattr(DatasetWriter, method, fails)
    with pytest.raises(type(error)) as raised:
        run(out, 4, environments=2)
    monkeypatch.undo()
    told = caplog.text if error is not NO_ROOM else str(raised.value)
    reason = "" if error is not NO_ROOM else ": No space left on device;"
    assert f"{out}{reason or ':'} {kept} of 4 episodes are kept, and the same command goes on from there" in told
    info = json.loads((out / "meta/info.json").read_text())
    assert info["total_episodes"] == kept and info["total_frames"] == sum(map(len, tables(out)))
    assert run(out, 4, environments=5)[0] == 4
    for mine, other in zip(tables(out), tables(whole), strict=True):
        assert mine.equals(other)
    for name in ("meta/info.json", "meta/stats.json", "README.md"):
        assert (out / name).read_text() == (whole / name).read_text(), name
    untold = out / "data/chunk-000/file-007.parquet"
    untold.write_bytes(b"PAR1")  # of a process that was killed
    assert run(out, 4) == (4, 0), "there is nothing left to do"
    assert not untold.exists() and len(tables(out)) == 4
    assert (out / "set_aside/data/chunk-000/file-007.parquet").exists() and f"are in {out / 'set_aside'} now" in caplog.text


def test_other_folders_and_other_options_are_refused(whole, tmp_path):
    with pytest.raises(SequenceError, match="whole was begun with noise 0.3; continue it with the same options, or choose another name"):
        run(whole, 5, noise=0.1)
    with pytest.raises(SequenceError, match="was begun with image_width 40"):
        run(whole, 5, sight=SightConfig(image_width=48, eyes=2, segmentation=True))
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.txt").write_text("a")
    with pytest.raises(SequenceError, match="photos exists already and has no demonstrations"):
        run(tmp_path / "photos", 1)
    (tmp_path / "photos/meta").mkdir()
    with pytest.raises(SequenceError, match="photos has no meta/demonstrations.json that can be read, .*; copy the dataset again, if"):
        run(tmp_path / "photos", 1)
    with pytest.raises(SequenceError, match="41×33 images make no video"):
        config = DemonstrationConfig(episodes=1, environments=1)
        demonstrate("retraction", ["phantom:0"], tmp_path / "odd", config, SightConfig(image_width=41), device="cpu")
    assert not (tmp_path / "odd").exists()


def test_the_readme_tells_what_numbers_of_each_task_mean():
    told = {name: _told(task, True) for name, task in TASKS.items()}
    assert told["palpation"]["step"] == 3 and "reports the place" in told["palpation"]["fourth"]
    assert told["clip"]["labels"].endswith("right jaw of PSM1, 7 vessel, 8 other vessels, 9 clip") and "0.08 rad" in told["clip"]["twist"]
    second = "7 to 11 shaft, wrist, hook (of a tool without jaws), left jaw, right jaw of PSM2, 12 needle"
    assert told["handover"]["labels"].endswith(second)
    assert _told(TASKS["handover"], False)["labels"] == "0 nothing, 1 tissue"
    assert (told["camera"]["turn"], told["camera"]["roll"]) == (0.01, 0.02)


@pytest.mark.thorough
@pytest.mark.slow
def test_scenes_take_turns_and_the_number_of_environments_does_not_matter(tmp_path):
    config = DemonstrationConfig(episodes=5, images="png", seed=3)
    roots = [tmp_path / name for name in ("two", "three")]
    for root, environments in zip(roots, (2, 3)):
        demonstrate("retraction", ["phantom:0", "phantom:1"], root, replace(config, environments=environments), SIGHT, device="cpu")
    for mine, other in zip(*map(tables, roots), strict=True):
        assert mine.equals(other)
    for table in tables(roots[0]):
        seed = table.column("seed")[0].as_py()
        environment = make("retraction", scene=f"phantom:{seed % 2}")
        state, _ = environment.reset(seed=seed)
        np.testing.assert_array_equal(np.array(table.column("observation.environment_state")[0].as_py(), np.float32), state)
    with pytest.raises(SequenceError, match="was begun with scenes "):
        demonstrate("retraction", ["phantom:0"], roots[0], config, SIGHT, device="cpu")


def test_a_scene_that_the_task_refuses_is_left_out_with_a_reason(tmp_path, caplog, small):
    config = DemonstrationConfig(episodes=1, environments=1)
    demonstrate("retraction", [small, "phantom:0"], tmp_path / "out", config, SIGHT, device="cpu")
    assert f"{small} is left out: retraction: " in caplog.text
    assert json.loads((tmp_path / "out/meta/demonstrations.json").read_text())["scenes"] == ["phantom:0"]
    with pytest.raises(ValueError, match="retraction: "):
        demonstrate("retraction", [small], tmp_path / "none", config, SIGHT, device="cpu")
    with pytest.raises(ModelError, match="nowhere.ply"):
        demonstrate("retraction", ["phantom:0", "nowhere.ply"], tmp_path / "none", config, SIGHT, device="cpu")
    for given, sentence in (
        (["phantom:0", "phantom:1", "phantom:0"], "phantom:0: the same scene as phantom:0; give each once"),
        (["phantom:0", "phantom:00"], "phantom:00: the same scene as phantom:0; give each once"),
        ([small, Path(small).parent], f"{Path(small).parent}: the same scene as {small}; give each once"),
    ):
        with pytest.raises(ValueError, match=f"^{sentence}$"):
            demonstrate("retraction", given, tmp_path / "none", config, SIGHT, device="cpu")
    assert not (tmp_path / "none").exists()


def test_a_round_without_a_solved_episode_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(demonstrations, "_FEWEST", 0.5)
    with pytest.raises(SequenceError, match="0 of 3 episodes were solved"):
        run(tmp_path / "out", 3, noise=2.0)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="there is no scene; give one or more, such as phantom:0"):
        demonstrate("retraction", [], tmp_path / "out", device="cpu")
    with pytest.raises(ValueError, match="^phantom:1: .*nowhere.urdf"):
        demonstrate("retraction", ["phantom:0", "phantom:1"], tmp_path / "out", sight=SightConfig(tool="nowhere.urdf"), device="cpu")


def test_a_script_that_hardly_solves_anything_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(demonstrations, "_FEWEST", 1.01)
    with pytest.raises(SequenceError, match=r"\d+ of 3 episodes were solved; less noise or randomisation helps"):
        run(tmp_path / "out", 50)


def test_a_dataset_that_was_cut_off_is_not_continued(tmp_path):
    features = {"x": vector_feature(["a", "b"])}
    writer = DatasetWriter(tmp_path, "t", 25, features)
    writer.add(({"x": np.ones((3, 2), np.float32)}, {}))
    writer.save()
    assert DatasetWriter(tmp_path, "t", 25, features).column("x").shape == (3, 2)
    with pytest.raises(SequenceError, match="is of the task 't', not 'u'"):
        DatasetWriter(tmp_path, "u", 25, features)
    with pytest.raises(SequenceError, match="has other columns, images or rates"):
        DatasetWriter(tmp_path, "t", 30, features)
    info = (tmp_path / "meta/info.json").read_text()
    (tmp_path / "meta/info.json").write_text(info.replace('"x"', '"command.pose"'))
    with pytest.raises(SequenceError, match=r"older version \(command.pose is action.cartesian_absolute now\); choose another name"):
        DatasetWriter(tmp_path, "t", 25, features)
    (tmp_path / "meta/info.json").write_text(info)
    (path,) = tmp_path.glob("data/*/*.parquet")
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(SequenceError, match="data/chunk-000/file-000.parquet cannot be read; copy the dataset again"):
        DatasetWriter(tmp_path, "t", 25, features)


def test_files_that_do_not_agree_are_neither_continued_nor_read(tmp_path, caplog):
    """As those of a copy that was made while a run saved: nothing of it is written over."""
    features, whole = {"x": vector_feature(["a", "b"])}, tmp_path / "whole"
    writer = DatasetWriter(whole, "t", 25, features)
    for count, name in ((2, "earlier"), (4, "whole")):
        while writer.episodes < count:
            writer.add(({"x": np.ones((3, 2), np.float32)}, {}))
        writer.save()
        if name == "earlier":
            shutil.copytree(whole, tmp_path / name)

    def mixed(name, source, file, target=None):
        shutil.copytree(whole, tmp_path / name)
        shutil.copy(source / file, tmp_path / name / (target or file))
        return tmp_path / name

    table, data = "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-00{}.parquet"
    for root, sentence in (
        (mixed("table", tmp_path / "earlier", table), "has 2 of 4 episodes and 6 of 12 rows that meta/info.json tells of; copy"),
        (mixed("data", whole, data.format(1), data.format(2)), r"file-002.parquet has 3 rows of episode 1 for 3 of episode 2; copy"),
    ):
        files = {path: path.read_bytes() for path in root.rglob("*.*")}
        for use in (lambda: DatasetWriter(root, "t", 25, features), lambda: dataset.read_dataset(root, ("x",), ())):
            with pytest.raises(SequenceError, match=sentence):
                use()
        assert files == {path: path.read_bytes() for path in root.rglob("*.*")}
    histograms = mixed("histograms", tmp_path / "earlier", table)
    shutil.copy(whole / table, histograms / table)
    (histograms / "meta/image_histograms.npz").unlink()
    with pytest.raises(SequenceError, match="histograms.npz are not those that meta/info.json tells of; copy the dataset again"):
        DatasetWriter(histograms, "t", 25, features)
    moved = mixed("moved", whole, data.format(3), data.format(7))
    (moved / data.format(3)).unlink()
    rows = pq.read_table(moved / table).to_pylist()
    rows[3]["data/file_index"] = 7
    pq.write_table(pa.Table.from_pylist(rows), moved / table)
    assert len(dataset.read_dataset(moved, ("x",), ())[0]["x"]) == 12
    with pytest.raises(SequenceError, match="moved has its files in other places than this command writes them; choose another name"):
        DatasetWriter(moved, "t", 25, features)
    newer = mixed("newer", tmp_path / "earlier", "meta/info.json")  # killed between the two
    assert len(dataset.read_dataset(newer, ("x",), ())[0]["x"]) == 6
    with pytest.raises(
        SequenceError, match=r"newer has more than the 2 episodes .* \(data/chunk-000/file-002.parquet\), and lerobot reads"
    ):
        dataset.check_dataset(newer, dataset.read_info(newer), ("x",))
    writer = DatasetWriter(newer, "t", 25, features)
    assert writer.episodes == 4 and not (newer / "set_aside").exists() and "tells of 2 episodes, but 4 were written" in caplog.text
    (newer / "meta/tasks.parquet").unlink()
    writer.save()
    for path in filter(Path.is_file, whole.rglob("*")):
        assert path.read_bytes() == (newer / path.relative_to(whole)).read_bytes(), path


@pytest.mark.parametrize("left", ["all", "data"])
def test_finished_episodes_without_info_are_not_removed(tmp_path, left):
    features, root = {"x": vector_feature(["a", "b"])}, tmp_path / "copied"
    writer = DatasetWriter(root, "t", 25, features)
    writer.add(({"x": np.ones((3, 2), np.float32)}, {}))
    writer.save()
    (root / "meta/info.json").unlink()
    if left == "data":
        shutil.rmtree(root / "meta")
    with pytest.raises(SequenceError, match=r"copied has data(, meta/episodes.*)?, but no meta/info.json, which is .* a copy that was"):
        DatasetWriter(root, "t", 25, features)
    assert len(tables(root)) == 1


@pytest.mark.parametrize("error", [NO_ROOM, KeyboardInterrupt()], ids=["full", "killed"])
def test_a_first_run_that_did_not_come_to_save_is_taken_up(tmp_path, monkeypatch, error):
    features = {"x": vector_feature(["a", "b"])}
    episode = {"x": np.ones((3, 2), np.float32)}, {}
    writer = DatasetWriter(tmp_path, "t", 25, features)
    writer.add(episode)
    written = DatasetWriter._write_json

    def ends(self, name, values):
        if name == "meta/info.json":
            raise error
        written(self, name, values)

    monkeypatch.setattr(DatasetWriter, "_write_json", ends)
    with pytest.raises(type(error)):
        writer.save()
    monkeypatch.undo()
    kept = 0 if error is NO_ROOM else 1  # which info.json does not tell of yet
    assert len(tables(tmp_path)) == kept
    with pytest.raises(SequenceError, match="has no episodes; give one with some"):
        dataset.read_dataset(tmp_path, ("x",), ())
    writer = DatasetWriter(tmp_path, "t", 25, features)
    assert writer.episodes == kept == len(tables(tmp_path))
    writer.add(episode)
    writer.save()
    assert dataset.read_dataset(tmp_path, ("x",), ())[0]["x"].shape == (3 * kept + 3, 2)


@pytest.mark.slow
def test_demonstrating_is_a_command_whose_dataset_lerobot_reads(tmp_path):
    out = tmp_path / "out"
    done = endo_sim_here("demonstrate", "retraction", out, "--episodes", 1, "--environments", 2, "--image-width", 80, "--device", "cpu")
    assert done.returncode == 0, done.stderr
    assert "out: 1 solved episode;" in done.stdout
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="needs lerobot")
    frames = lerobot.LeRobotDataset("local/out", root=out)
    assert frames.num_episodes == 1 and frames[0]["action"].shape == (4,) and dataset.VERSION == "v3.0"


def test_saving_a_dataset_that_grows_takes_a_tenth_of_the_time_at_most(tmp_path, monkeypatch):
    clock, saves = [0.0], []
    monkeypatch.setattr(demonstrations, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(demonstrations, "card", lambda *_: "")
    sight, config = SightConfig(image_width=16), DemonstrationConfig(images="png")
    growing = Demonstrations("retraction", ["phantom:0"], tmp_path, 1, config, sight, Randomisation(), MotionConfig(), "cpu")

    def save():
        clock[0] += 3.0 * (len(saves) + 1)
        saves.append(clock[0])

    (tmp_path / "meta").mkdir()
    growing._writer = SimpleNamespace(episodes=1, save=save)
    while clock[0] < 1000:
        clock[0] += 1.0
        growing.save_if_due()
    assert len(saves) > 3 and saves[0] < 15
    assert sum(3.0 * (n + 1) for n in range(len(saves))) < 0.13 * clock[0]


def test_without_the_codec_of_videos_it_is_said_what_is_missing(tmp_path, monkeypatch):
    import av

    def without(name, *rest):
        raise av.codec.codec.UnknownCodecError(name)

    monkeypatch.setattr(av.codec, "Codec", without)
    config = DemonstrationConfig(episodes=1, environments=1)
    with pytest.raises(RuntimeError, match="^PyAV has no libx264 here, which videos need; pip install"):
        demonstrate("retraction", ["phantom:0"], tmp_path, config, SightConfig(image_width=40), device="cpu")
    assert not any(tmp_path.iterdir()), "it was said before anything was played"
    monkeypatch.setitem(sys.modules, "av.codec", None)
    with pytest.raises(RuntimeError, match="^there is no PyAV here, which videos need; pip install"):
        demonstrate("retraction", ["phantom:0"], tmp_path, config, SightConfig(image_width=40), device="cpu")
