"""recorder_node in this process."""

import errno
import shutil
import subprocess
import sys

import pytest
from ros_bench import S, send_wrench

from endo_sim_ros import messages
from endo_sim_ros.messages import ERROR
from endo_sim_ros.nodes.recorder_node import RecorderNode
from endo_sim_ros.sequences.bag import BagReader, BagWriter

pytestmark = pytest.mark.dds

ENDED = """
import sys, rclpy
from pathlib import Path
from rclpy.executors import SingleThreadedExecutor
from endo_sim_ros.nodes.recorder_node import record
spin_once = SingleThreadedExecutor.spin_once
def shut_down_before(executor, timeout_sec=None):
    rclpy.shutdown()  # as its thread does after a signal
    spin_once(executor, timeout_sec)
SingleThreadedExecutor.spin_once = shut_down_before
record(Path(sys.argv[1]), ("PSM1",), ("all",))
"""


@pytest.fixture
def recording(ros):
    """Where a recorder in this process writes."""
    shutil.rmtree(ros, ignore_errors=True)
    return ros


def test_a_recorder_on_a_full_disk_says_so_and_keeps_no_messages(bench, recording, monkeypatch):
    def full(self, *_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(BagWriter, "write_raw", full)
    recorder = bench.add(RecorderNode)
    bench.refused("recorder", f"recording stopped: {recording}: there is no room on this disk; make room, or name a place on another disk;")
    for number in range(50):
        send_wrench(bench, (0, 0, 1.0), stamp=S + number)
        bench.executor.spin_once(timeout_sec=0.01)
    bench.until(lambda: recorder.dropped >= 50, "messages to be dropped")
    assert recorder.queue.qsize() < 3 and recorder.status()[0] == ERROR


def test_a_recorder_keeps_what_was_said_and_refuses_to_overwrite(bench, recording):
    recorder = bench.add(RecorderNode)
    send_wrench(bench, (1.0, 2.0, 3.0))
    recorder._recorder(messages.DEPTH)(bytes(5_000_000))  # which compress well
    bench.until(lambda: recorder.written >= 3, "messages to be written")
    bench.executor.remove_node(recorder)
    bench.nodes.remove(recorder)
    recorder.destroy_node()
    assert recorder.summary.endswith(" topics, 0.0 MB"), "what there is on the disk"
    with BagReader(recording) as bag:
        ((topic, _, message),) = bag.messages([messages.tool_wrench("PSM1")])
    assert message.wrench.force.y == 2.0
    bench.add(RecorderNode)
    bench.refused("recorder", "exists already")


def test_a_recording_whose_end_ros_hears_before_python_is_closed_and_told(tmp_path):
    done = subprocess.run([sys.executable, "-c", ENDED, tmp_path / "bag"], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0 and done.stdout.endswith("bag: 0 messages of 0 topics, 0.0 MB\n"), done.stderr
    assert (tmp_path / "bag" / "metadata.yaml").exists()
