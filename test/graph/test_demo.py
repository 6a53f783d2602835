"""`endo-sim demo`, its nodes as processes that begin where all is imported."""

import os
import re
import shutil

import cv2
import numpy as np
import pytest
from endo_sim_command import endo_sim_here
from forked_nodes import ForkedNodes
from mcap.reader import make_reader

from endo_sim_ros.core.gaussians import load_ply
from endo_sim_ros.graph import demo


class ShortTouch(ForkedNodes):
    """The tool pulls, swings and lets go in two and a half seconds, not in eight and a half."""

    def start(self, name, *ros_arguments, **parameters):
        times = {"pull": 0.5, "swing": 1.0, "release": 1.0} if name == "scripted_tool_node" else {}
        return super().start(name, *ros_arguments, **parameters, **times)


@pytest.mark.dds
def test_demo_runs_the_whole_graph_and_leaves_its_results(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "NodeGroup", ShortTouch)
    monkeypatch.setattr(os, "environ", os.environ.copy())  # the command joins the graph of its nodes
    options = {"--frames": 4, "--width": 64, "--iterations": 30, "--timeout": 240, "--force": 1.0}
    done = endo_sim_here("demo", "--out", tmp_path, *(word for pair in options.items() for word in pair))
    assert done.returncode == 0, done.stderr + done.stdout
    video = cv2.VideoCapture(str(tmp_path / "touch.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) > 100 and video.get(cv2.CAP_PROP_FPS) == 25
    frames = [video.read()[1].astype(int) for _ in range(100)]
    assert np.abs(frames[0] - frames[60]).mean() > 1  # the tissue moved
    sheet = cv2.imread(str(tmp_path / "contact_sheet.png"))
    assert sheet.shape[1] == 3 * 256 and sheet.std() > 10
    assert len(load_ply(tmp_path / "model.ply")) > 1000
    with next((tmp_path / "recording").glob("*.mcap")).open("rb") as file:
        summary = make_reader(file).get_summary()
        counts = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
    for topic in (
        "gaussians",
        "control_nodes",
        "PSM1/jaw/servo_jp",
        "PSM1/body/measured_cf",
        "rendered/image_raw/compressed",
        "diagnostics",
    ):
        assert counts[f"/{topic}"] > 0, topic


@pytest.mark.dds
def test_a_demo_in_which_nothing_goes_on_ends_and_leaves_no_results_of_another_patient(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "NodeGroup", ForkedNodes)
    monkeypatch.setattr(os, "environ", os.environ.copy())
    for name in ("touch.mp4", "contact_sheet.png", "model.ply", "cameras.json"):
        (tmp_path / name).write_text("of another patient")
    done = endo_sim_here("demo", "--out", tmp_path, "--frames", 2, "--width", 64, "--timeout", 0.001)
    assert done.returncode == 1 and re.search(r"starting made no progress for 0.001 s \(last: .*\); logs are in", done.stderr)
    assert {path.name for path in tmp_path.iterdir()} <= {"logs", "phantom_0", "recording"}


@pytest.mark.parametrize(
    "options, sentence",
    [
        (["--width", 3], r"image_width must lie in \[16, 8192\] pixels, got 3"),
        (["--iterations", -1], r"iterations must lie in \[0, 1000000\], got -1"),
        (["--force", -1], r"force must lie in \[0, 100\] N, got -1"),
        (["--frames", 0], r"frames must lie in \[1, 100000\], got 0"),
        (["--bag", "{out}/recording"], "recording: the demo writes its own recording there; give another folder for the results"),
        (["--bag", "{out}/nothing"], "nothing: no such bag"),
    ],
)
def test_what_the_demo_cannot_use_is_told_at_once_and_leaves_earlier_results(tmp_path, small_bag, options, sentence):
    shutil.copytree(small_bag, tmp_path / "recording")
    before = sorted(tmp_path.rglob("*"))
    done = endo_sim_here("demo", "--out", tmp_path, *(str(word).format(out=tmp_path) for word in options))
    assert done.returncode == 2 and re.search(sentence, done.stderr), done.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_a_folder_for_the_demo_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    done = endo_sim_here("demo", "--out", tmp_path / "file")
    assert done.returncode == 2 and re.search("file: no files can be written there .*; name another folder", done.stderr), done.stderr
