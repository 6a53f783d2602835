"""Datasets in layout v2.1 of LeRobot, which Open-H asks for."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from endo_sim_command import endo_sim_here
from made_recordings import lockstep
from thorough import mostly_thorough

from endo_sim_ros.core import drawing
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.dataset import _INDICES, IMAGE, IMAGE_RIGHT, SEGMENTATION, STATE, DatasetWriter, read_dataset
from endo_sim_ros.learning.lerobot import export_lerobot
from endo_sim_ros.learning.lerobot_v21 import to_v21


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module", params=mostly_thorough(["video", "png"]))
def dataset(request, tmp_path_factory):
    """Two episodes with labels, in v3.0."""
    folder = tmp_path_factory.mktemp(request.param)
    bag = lockstep(folder / "bag", everything=True)
    export_lerobot([bag, bag], folder / "out", "pull", images=request.param)
    return folder / "out"


def test_a_dataset_is_the_same_in_layout_v21(dataset, tmp_path):
    out = tmp_path / "out"
    done = endo_sim_here("export", dataset, out, "--format", "lerobot-2.1")
    assert done.returncode == 0 and "2 episodes, 22 frames" in done.stdout
    info, before = (json.loads((root / "meta/info.json").read_text()) for root in (out, dataset))
    assert info["codebase_version"] == "v2.1" and info["features"] == before["features"] and info["total_frames"] == 22
    videos = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    assert (info["total_videos"], info["total_chunks"]) == (2 * len(videos), 1)
    told = lines(out / "meta/episodes.jsonl"), lines(out / "meta/episodes_stats.jsonl")
    for number, (episode, statistics) in enumerate(zip(*told, strict=True)):
        assert episode == {"episode_index": number, "tasks": ["pull"], "length": 11}
        table = pq.read_table(out / info["data_path"].format(episode_chunk=0, episode_index=number))
        old = before["data_path"].format(chunk_index=0, file_index=number)
        assert table.equals(pq.read_table(dataset / old))
        kinds = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
        assert kinds[SEGMENTATION] == {"_type": "Image"} and set(kinds) == set(table.column_names)
        assert kinds[STATE]["length"] == len(table[STATE][0]) and kinds["index"] == {"dtype": "int64", "_type": "Value"}
        assert set(statistics["stats"]) == set(info["features"]) and statistics["episode_index"] == number
        assert statistics["stats"][IMAGE]["count"] == [11] and len(statistics["stats"][STATE]["mean"]) == kinds[STATE]["length"]
        for key in videos:
            video = out / info["video_path"].format(episode_chunk=0, episode_index=number, video_key=key)
            assert len(drawing.read_video(video)) == 11
    assert lines(out / "meta/tasks.jsonl") == [{"task_index": 0, "task": "pull"}]
    with pytest.raises(SequenceError, match="out exists already"):
        to_v21(dataset, out)
    with pytest.raises(SequenceError, match="out is a LeRobot dataset v2.1; give one of v3.0"):
        to_v21(out, tmp_path / "again")


def test_the_readme_of_a_copy_says_how_the_copy_is_loaded(dataset, tmp_path):
    written = changed(dataset, tmp_path / "written")
    example, other = "```python\nLeRobotDataset('local/old', root='old')\n```", "```python\n1\n```\n"
    text = f"# pull\n\nAs it was: `LeRobotDataset`.\n\n{example}\n\n## More\n\n{other}"
    (written / "README.md").write_text(text)
    to_v21(written, tmp_path / "copy")
    copied = (tmp_path / "copy/README.md").read_text()
    assert 'LeRobotDataset  # of lerobot 0.3\n\ndataset = LeRobotDataset("local/copy", root="copy")\n```\n\n## More' in copied
    assert copied.startswith("# pull\n\nAs it was: `LeRobotDataset`.") and copied.endswith(other) and "old" not in copied


def test_what_is_no_dataset_leaves_nothing_behind(dataset, tmp_path):
    with pytest.raises(SequenceError, match="bag is no LeRobot dataset that can be read; give the folder that"):
        to_v21(dataset.parent / "bag", tmp_path / "out")
    done = endo_sim_here("export", dataset, tmp_path / "out", "--format", "lerobot-2.1", "--fps", 3)
    assert done.returncode == 2 and "takes one dataset, then the folder of the new one, and no other options" in done.stderr
    (dataset / "data/chunk-000/file-001.parquet").rename(dataset / "away")
    try:
        with pytest.raises(SequenceError, match="file-001.parquet cannot be read; copy the dataset again"):
            to_v21(dataset, tmp_path / "out")
    finally:
        (dataset / "away").rename(dataset / "data/chunk-000/file-001.parquet")
    assert not (tmp_path / "out").exists()


def changed(dataset, out, **info):
    """A copy with other entries of info.json."""
    shutil.copytree(dataset, out)
    told = json.loads((out / "meta/info.json").read_text())
    (out / "meta/info.json").write_text(json.dumps(told | info))
    return out


def test_datasets_that_v21_cannot_hold_are_told_what_they_are(dataset, tmp_path):
    merged = changed(dataset, tmp_path / "merged")
    first, second = sorted(merged.glob("data/*/*"))
    pq.write_table(pa.concat_tables([pq.read_table(first), pq.read_table(second)]), first)
    second.unlink()
    (table,) = merged.glob("meta/episodes/*/*")
    rows = pq.read_table(table).to_pylist()
    for key in [key for key in rows[1] if key.endswith("/file_index")]:
        rows[1][key] = 0
    pq.write_table(pa.Table.from_pylist(rows), table)
    for use in (lambda: to_v21(merged, tmp_path / "out"), lambda: read_dataset(merged, (STATE,), (IMAGE,))):
        with pytest.raises(SequenceError, match="merged has several episodes in one file, as lerobot's own tools write them; give"):
            use()
    several = changed(dataset, tmp_path / "several")
    (table,) = several.glob("meta/episodes/*/*")
    pq.write_table(pa.Table.from_pylist([row | {"tasks": [str(i)]} for i, row in enumerate(pq.read_table(table).to_pylist())]), table)
    with pytest.raises(SequenceError, match="several has 2 episodes of 2 tasks; give one with episodes of one task"):
        to_v21(several, tmp_path / "out")
    none = changed(dataset, tmp_path / "none", total_episodes=0, total_frames=0)
    with pytest.raises(SequenceError, match="none has 0 episodes of 0 tasks"):
        to_v21(none, tmp_path / "out")
    (none / "meta/info.json").write_text("[1]")
    with pytest.raises(SequenceError, match="none is no LeRobot dataset that can be read; give the folder"):
        to_v21(none, tmp_path / "out")
    old = changed(dataset, tmp_path / "old", codebase_version="v2.1")
    with pytest.raises(SequenceError, match="old is a LeRobot dataset v2.1; give one of v3.0, as `endo-sim demonstrate` writes it"):
        read_dataset(old, (STATE,), (IMAGE,))
    for inside in (dataset, dataset / "v21"):
        with pytest.raises(SequenceError, match="is in the dataset itself; give the copy a folder of its own"):
            to_v21(dataset, inside)
    assert not (tmp_path / "out").exists()


def test_files_that_were_cut_off_are_told(dataset, tmp_path):
    cut, info = changed(dataset, tmp_path / "cut"), json.loads((dataset / "meta/info.json").read_text())
    path = max(cut.rglob("*.mp4"), default=max(cut.glob("data/*/*")))
    if path.suffix == ".mp4":
        path.write_bytes(path.read_bytes()[:-200])
        said = f"cut: {path.relative_to(cut)} cannot be read; copy the dataset again"
        features = {key: feature for key, feature in info["features"].items() if key not in _INDICES}
        for use in (lambda: read_dataset(cut, (STATE,), (IMAGE, IMAGE_RIGHT)), lambda: DatasetWriter(cut, "pull", info["fps"], features)):
            with pytest.raises(SequenceError, match=said):
                use()
        with pytest.raises(SequenceError, match=said):
            to_v21(cut, tmp_path / "out")
        drawing.write_video(path, np.zeros((3, 32, 32, 3), np.uint8), 25)
        said = "has 3 images for 11 rows; copy the dataset again"
    else:
        pq.write_table(pq.read_table(path)[:4], path)
        said = "file-001.parquet has 4 rows of episode 1 for 11 of episode 1; copy the dataset again"
    with pytest.raises(SequenceError, match=said):
        to_v21(cut, tmp_path / "out")
    assert not (tmp_path / "out").exists()
