"""`endo-sim demo`, its nodes as processes that begin where all is imported."""

import os

import cv2
import numpy as np
import pytest
from endo_sim_command import endo_sim_here
from forked_nodes import ForkedNodes
from mcap.reader import make_reader

from endo_sim_ros.core.gaussians import load_ply
from endo_sim_ros.graph import demo

pytestmark = pytest.mark.dds


class ShortTouch(ForkedNodes):
    """The tool pulls, swings and lets go in two and a half seconds, not in eight and a half."""

    def start(self, name, *ros_arguments, **parameters):
        times = {"pull": 0.5, "swing": 1.0, "release": 1.0} if name == "scripted_tool_node" else {}
        return super().start(name, *ros_arguments, **parameters, **times)


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
    assert sheet.shape[1] == 3 * 64 and sheet.std() > 10
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
