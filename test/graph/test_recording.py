"""Recordings that survive their recorder, full disks and namespaces."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from thorough import mostly_thorough
from waiting import wait_until

from endo_sim_ros import messages
from endo_sim_ros.messages import bag_types
from endo_sim_ros.sequences.bag import BagReader

pytestmark = pytest.mark.dds

ROOT = Path(__file__).parents[2]
S = 1_000_000_000


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

    def say_for(self, seconds):
        """At the rate of a camera: a recorder that gets no core for half a second is still sent all that waits for it."""
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            self.say()
            while time.monotonic() < now + 1 / 30:
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "number",
    [*(pytest.param(each, marks=pytest.mark.thorough) for each in (signal.SIGINT, signal.SIGTERM)), signal.SIGKILL],
    ids=lambda number: number.name,
)
def test_what_was_recorded_outlives_the_recorder(graph, tmp_path, number):
    path = tmp_path / "my récording"  # a name that must be quoted
    recorder = start("endo_sim_ros.cli", "record", path, "--images", "raw", "--arms", "PSM1", "PSM2")
    try:
        wait_until(graph.heard, 30, "the recorder", graph.step)
        graph.say_for(1.5)  # each side of a topic finds the other in its own time
        began = len(graph.sent)
        graph.say_for(3.0 if number == signal.SIGKILL else 1.0)
        if number != signal.SIGKILL:  # these end a recorder that hears all; a kill may lose the last second
            settled = time.monotonic() + 0.5
            wait_until(lambda: time.monotonic() > settled, 5, "the last message to arrive", graph.step)
    finally:
        recorder.send_signal(number)
        output, _ = recorder.communicate(timeout=120)
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
        graph.say_for(1.5)
    finally:
        recorder.send_signal(signal.SIGINT)
        recorder.communicate(timeout=120)
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) == {"/rendered/image_raw", "/PSM1/measured_cp"}
        for raw in bag.raw_messages():
            typestore = bag_types().typestore
            again = typestore.serialize_cdr(typestore.deserialize_cdr(raw.data, raw.type), raw.type)
            assert bytes(again) == bytes(raw.data)


@pytest.mark.thorough
@pytest.mark.parametrize("graph", ["left"], indirect=True)
def test_a_graph_in_a_namespace_is_recorded_under_the_names_without_it(graph, tmp_path):
    other = graph.node.publisher(messages.tool_pose("PSM1")._replace(name="/PSM1/measured_cp"))  # a graph without a namespace
    arguments = ("--images", "raw", "--arms", "PSM1", "PSM2", "--namespace", "/left/")
    recorder = start("endo_sim_ros.cli", "record", tmp_path / "bag", *arguments)
    try:
        wait_until(graph.heard, 30, "the recorder", graph.step)
        graph.say_for(1.5)  # each side of a topic finds the other in its own time
        began = len(graph.sent)
        for _ in range(20):
            graph.say()
            other.publish(messages.encode_pose(np.eye(4), 7, "world"))
        settled = time.monotonic() + 1.0
        wait_until(lambda: time.monotonic() > settled, 5, "the last message to arrive", graph.step)
    finally:
        recorder.send_signal(signal.SIGINT)
        output, _ = recorder.communicate(timeout=120)
    assert recorder.returncode == 0 and "Traceback" not in output, output
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) >= {f"/{topic.name}" for topic in graph.publishers}
        assert not any("left" in name for name in bag.topics)
    for topic in graph.publishers:
        kept = read_stamps(tmp_path / "bag", topic)
        assert set(graph.sent[began:]) <= set(kept) and 7 not in kept, topic.name


@pytest.fixture(params=mostly_thorough(["limit", "small disk"]))
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
        yield disk, {}, "there is no room on this disk; make room, or name a place on another disk"
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_recorder_on_a_full_disk_says_so_lives_on_and_keeps_what_it_wrote(graph, full_disk):
    disk, options, reason = full_disk
    parameters = ("-p", f"bag:={disk / 'bag'}", "-p", "arms:=[PSM1, PSM2]", "-p", "images:=raw")
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
        output, _ = recorder.communicate(timeout=120)
    assert recorder.returncode == 0 and "Traceback" not in output, output
    kept = read_stamps(disk / "bag", messages.RENDERED_IMAGE)
    assert len(kept) > 30  # 24 kB each
    kept = kept[2:]  # each side of a topic finds the other in its own time, which may cost one between two that arrive
    first = graph.sent.index(kept[0])
    assert kept == graph.sent[first : first + len(kept)]  # none missing before the last chunk


@pytest.mark.thorough
def test_record_on_a_full_disk_ends_with_the_sentence(graph, tmp_path):
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, 1_500_000))  # noqa: E731
    recorder = start("endo_sim_ros.cli", "record", tmp_path / "bag", "--images", "raw", "--arms", "PSM1", "PSM2", preexec_fn=limit)
    try:
        wait_until(graph.heard, 30, "the recorder", graph.step)
        wait_until(lambda: recorder.poll() is not None, 30, "the recorder to end", graph.say)
    finally:
        recorder.kill()
        output, _ = recorder.communicate(timeout=120)
    assert recorder.returncode == 1 and "endo-sim: recording stopped: " in output and "Traceback" not in output, output
    assert len(read_stamps(tmp_path / "bag", messages.RENDERED_IMAGE)) > 15  # 24 kB each; a chunk of 1 MB may be lost
