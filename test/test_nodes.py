"""The nodes of the graph: what they do with good input, with bad input, and when they come and go."""

import errno
import itertools
import shutil
import signal
import sys
import threading
import time
from collections import defaultdict

import numpy as np
import pytest
import rclpy
import torch
from conftest import wait_until
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, make_pose
from endo_sim_ros.core.gaussians import GaussianModel, load_ply, save_ply
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.messages import ERROR, OK, WARN
from endo_sim_ros.nodes.base import _MOST_LOGGED, EndoNode
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.rclpy_private import spin
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNode
from endo_sim_ros.nodes.recorder_node import RecorderNode
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.nodes.scripted_tool_node import ScriptedToolNode
from endo_sim_ros.physics.control_nodes import build_control_nodes
from endo_sim_ros.sequences.bag import BagReader, BagWriter

S = 1_000_000_000
K = np.array([[90.0, 0, 48], [0, 90.0, 40], [0, 0, 1]])
WIDTH, HEIGHT = 96, 80
SMALL = {
    "reconstruction_node": {"iterations": 30, "max_gaussians": 1500, "image_width": WIDTH, "start_after": 0.0},
    "physics_node": {"node_count": 300, "arms": "[PSM1, PSM2]", "substeps": 40, "force_radius": 0.02},
    "rendering_node": {"rate": 20.0},
}


@pytest.fixture(scope="module", autouse=True)
def ros(tmp_path_factory):
    """ROS with small parameters for the nodes that are made in this process."""
    outputs = {"reconstruction_node": {"output_dir": tmp_path_factory.mktemp("models")}}
    recording = tmp_path_factory.mktemp("recordings") / "bag"
    outputs |= {"recorder": {"bag": recording}}
    arguments = ["--ros-args"]
    for node, values in [*SMALL.items(), *outputs.items()]:
        for name, value in values.items():
            arguments += ["-p", f"{node}:{name}:={value}"]
    rclpy.init(args=arguments)
    yield recording
    rclpy.try_shutdown()


class Bench:
    """Nodes in this process, and a user who talks to all nodes of the graph and hears what they say."""

    def __init__(self):
        self.executor = SingleThreadedExecutor()
        self.user = EndoNode("user")
        self.nodes = [self.user]
        self.executor.add_node(self.user)
        self.statuses = defaultdict(list)  # (level, text, values) by node name
        self.heard = defaultdict(list)  # messages by topic name
        self._publishers = {}
        self.user.subscribe(messages.DIAGNOSTICS, self._on_diagnostics, depth=1000)

    def _on_diagnostics(self, message):
        for name, *status in messages.decode_diagnostics(message):
            self.statuses[name].append(status)

    def add(self, node_class):
        node = node_class()
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def hear(self, topic):
        self.user.subscribe(topic, self.heard[topic.name].append)
        return self.heard[topic.name]

    def publish(self, topic, message):
        publisher = self._publishers.get(topic)
        if publisher is None:
            publisher = self._publishers[topic] = self.user.publisher(topic, depth=200)
            self.until(publisher.get_subscription_count, f"a subscriber of {topic.name}")
        publisher.publish(message)

    def until(self, condition, what="a condition", seconds=20.0):
        return wait_until(condition, seconds, what, lambda: self.executor.spin_once(timeout_sec=0.02))

    def spin(self, seconds):
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.02)

    def status(self, name, text, level=None, since=0):
        """Wait until a node says something that contains a text; returns (level, text, values)."""

        def found():
            said = [s for s in self.statuses[name][since:] if text in s[1] and level in (None, s[0])]
            return said[-1] if said else None

        return self.until(found, lambda: f"{name} to say {text!r}; it said {self.statuses[name][-3:]}")

    def refused(self, name, text, *others):
        """Wait for one clear sentence about an error on /diagnostics."""
        level, sentence, _ = self.status(name, text, ERROR)
        assert "\n" not in sentence and "unexpected" not in sentence and "Traceback" not in sentence
        for other in others:
            assert other in sentence
        return sentence

    def call(self, kind, name, **fields):
        client = self.user.create_client(kind, name)
        self.until(client.service_is_ready, f"the service {name}")
        asked = []  # a killed node's service looks ready for 20 s more, and what is sent to it alone is lost: ask again

        def answered():
            done = next((future for _, future in asked if future.done()), None)
            if done is None and (not asked or time.monotonic() - asked[-1][0] > 8):
                asked.append((time.monotonic(), client.call_async(kind.Request(**fields))))
            return done

        future = self.until(answered, f"an answer of {name}")
        self.user.destroy_client(client)
        return future.result()

    def set(self, node, **values):
        """Like `ros2 param set`: (successful, reason) of the last one."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        (*_, result) = self.call(SetParameters, f"/{node}/set_parameters", parameters=parameters).results
        return result.successful, result.reason

    def close(self):
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.close()


def test_a_node_serves_what_is_there_and_what_is_added_or_removed_meanwhile(bench):
    context = Context()
    rclpy.init(context=context)
    node, ticks, end = EndoNode("loop", context), [], []
    heard = {topic: [] for topic in (messages.CAMERA_POSE, messages.LEFT_INFO)}
    node.subscribe(messages.CAMERA_POSE, heard[messages.CAMERA_POSE].append)

    def exchange(_):
        node.destroy_subscription(next(s for s in node.subscriptions if s.topic_name.endswith("measured_cp")))
        node.subscribe(messages.LEFT_INFO, heard[messages.LEFT_INFO].append)
        node.every(0.02, lambda: ticks.append(0))
        return True, "exchanged"

    def serve():
        try:
            spin(node)
        except ExternalShutdownException as error:
            end.append(error)

    node.service(Trigger, "~/exchange", exchange)
    thread = threading.Thread(target=serve)
    thread.start()
    try:
        for stamp in (1, 2, 3):
            bench.publish(messages.CAMERA_POSE, messages.encode_pose(np.eye(4), stamp * S, "world"))
        bench.until(lambda: [m.header.stamp.sec for m in heard[messages.CAMERA_POSE]] == [1, 2, 3], "poses")
        assert bench.call(Trigger, "/loop/exchange").message == "exchanged" and bench.set("loop", use_sim_time=False)[0]
        send_camera(bench, stamp=4 * S)
        bench.until(lambda: heard[messages.LEFT_INFO] and len(ticks) > 3, "what was added")
        assert len(heard[messages.CAMERA_POSE]) == 3 and thread.is_alive()
    finally:
        rclpy.shutdown(context=context)
        thread.join(5)
        node.destroy_node()
    assert not thread.is_alive() and end


# ------------------------------------------------------------------------------------------------------ material


def sheet(side=30, z=0.1, half=0.05, tilt=0.0):
    """A flat piece of tissue in front of the camera, with a pattern that shows how it moves.

    With a tilt the order of the Gaussians in depth is clear; without, the least movement changes it and the picture.
    """
    x, y = torch.meshgrid(torch.linspace(-half, half, side), torch.linspace(-half, half, side), indexing="ij")
    points = torch.stack([x, y, z + tilt * (x + 0.6 * y)], -1).reshape(-1, 3)
    stripes = 0.5 + 0.4 * torch.sin(points[:, 0] * 400) * torch.cos(points[:, 1] * 300)
    colors = torch.stack([stripes, 0.6 * stripes, 0.3 + 0 * stripes], 1)
    return GaussianModel.from_points(points, colors, torch.full((len(points),), half / side), opacity=0.95)


def send_model(bench, model=None, stamp=5 * S, cameras=(np.eye(4),), frame="world"):
    if cameras is not None:
        bench.publish(messages.TRAINING_CAMERAS, messages.encode_poses(list(cameras), stamp, frame))
    bench.publish(messages.GAUSSIANS, messages.encode_gaussians(model or sheet(), stamp, frame))


def send_camera(bench, pose=None, width=WIDTH, height=HEIGHT, stamp=S):
    matrix = K * [[width / WIDTH], [height / HEIGHT], [1]]
    bench.publish(messages.LEFT_INFO, messages.encode_camera_info(matrix, width, height, stamp, "endoscope_left"))
    bench.publish(messages.CAMERA_POSE, messages.encode_pose(np.eye(4) if pose is None else pose, stamp, "world"))


def send_tip(bench, position=(0, 0, 0.1), arm="PSM1", stamp=S):
    pose = np.eye(4)
    pose[:3, 3] = position
    bench.publish(messages.tool_pose(arm), messages.encode_pose(pose, stamp, "world"))


def send_wrench(bench, force, arm="PSM1", frame="world", stamp=S):
    bench.publish(messages.tool_wrench(arm), messages.encode_wrench(np.array(force), np.zeros(3), stamp, frame))


def send_frames(bench, frames, shift_ns=0, poses=True):
    """A recording, as fast as the executor hears it."""
    for frame in frames:
        stamp, camera = frame.stamp_ns + shift_ns, frame.camera
        size = camera.width, camera.height
        info = messages.encode_camera_info(camera.K, *size, stamp, "endoscope_left")
        bench.publish(messages.LEFT_INFO, info)
        if poses:
            bench.publish(messages.CAMERA_POSE, messages.encode_pose(camera.pose, stamp, "world"))
        bench.publish(messages.LEFT_IMAGE, messages.encode_image(frame.image, stamp, "endoscope_left"))
        bench.publish(messages.DEPTH, messages.encode_image(frame.depth, stamp, "endoscope_left"))
        for _ in range(10):
            bench.executor.spin_once(timeout_sec=0)


def nodes_of(bench):
    """The newest control nodes."""
    return messages.decode_control_nodes(bench.heard["control_nodes"][-1])


def await_nodes(bench, stamp_ns):
    bench.until(
        lambda: bench.heard["control_nodes"] and nodes_of(bench).model_stamp_ns == stamp_ns,
        f"control nodes of the model {stamp_ns}",
    )
    return nodes_of(bench)


def moved(bench):
    """Largest distance of a control node from rest, metres."""
    return np.linalg.norm(nodes_of(bench).positions - nodes_of(bench).rest, axis=1).max()


def pull(bench, condition, force=(0, 0, -1.0), position=(0, 0, 0.1), what="tissue to move"):
    """Hold a wrench until a condition is true."""

    def step():
        send_tip(bench, position)
        send_wrench(bench, force)
        for _ in range(10):
            bench.executor.spin_once(timeout_sec=0.005)

    wait_until(condition, 20, what, step)


def newest_image(bench):
    return messages.decode_image(bench.heard["rendered/image_raw"][-1]).astype(int)


def await_image(bench, condition=lambda image: True, what="an image"):
    seen = bench.heard["rendered/image_raw"]
    bench.until(lambda: seen and condition(newest_image(bench)), what)
    return newest_image(bench)


# ------------------------------------------------------------------------------------------------ reconstruction


@pytest.fixture
def reconstruction(bench):
    return bench.add(ReconstructionNode)


def views_arrive(bench, frames, shift_ns=S, count=12):
    """Whether a good recording still becomes views."""
    send_frames(bench, frames, shift_ns)
    bench.call(Trigger, "/reconstruction_node/save")  # some round trip; then flush as the end of a recording does
    node = next(node for node in bench.nodes if isinstance(node, ReconstructionNode))
    bench.until(lambda: (node._flush(), len(node._frames) == count)[1], lambda: f"{count} views: {node.status()}")


def bad_image(change):
    def make(frame):
        message = messages.encode_image(frame.image, frame.stamp_ns, "endoscope_left")
        change(message)
        return messages.LEFT_IMAGE, message

    return make


def bad_pose(change):
    def make(frame):
        message = messages.encode_pose(frame.camera.pose, frame.stamp_ns, "world")
        change(message)
        return messages.CAMERA_POSE, message

    return make


def bad_info(frame):
    message = messages.encode_camera_info(np.zeros((3, 3)), WIDTH, HEIGHT, frame.stamp_ns, "endoscope_left")
    return messages.LEFT_INFO, message


def damaged_jpeg(frame):
    message = messages.ros_class(messages.LEFT_COMPRESSED.type)(format="jpeg", data=b"\xff\xd8 not a picture")
    message.header.stamp.sec = 1
    return messages.LEFT_COMPRESSED, message


BAD_RECORDINGS = {
    "wrong_encoding": (bad_image(lambda m: setattr(m, "encoding", "yuv422")), "encoding 'yuv422' is not supported"),
    "mismatched_sizes": (bad_image(lambda m: setattr(m, "width", 200)), "size and data disagree"),
    "stamp_of_zero": (bad_image(lambda m: setattr(m.header, "stamp", type(m.header.stamp)())), "a stamp of zero"),
    "damaged_jpeg": (damaged_jpeg, "not a readable jpeg or png"),
    "zero_K": (bad_info, "the camera is not calibrated"),
    "non_finite_pose": (bad_pose(lambda m: setattr(m.pose.position, "x", float("nan"))), "the pose is not finite"),
    "non_unit_pose": (bad_pose(lambda m: setattr(m.pose.orientation, "w", 2.0)), "normalise it before publishing"),
    "unknown_frame": (bad_pose(lambda m: setattr(m.header, "frame_id", "base_link")), "unknown frame 'base_link'"),
}


@pytest.mark.parametrize("name", BAD_RECORDINGS)
def test_bad_recording_is_one_sentence_and_good_views_still_arrive(bench, reconstruction, small_frames, name):
    make, sentence = BAD_RECORDINGS[name]
    topic, message = make(small_frames[0])
    bench.publish(topic, message)
    where = "image: " if name == "stamp_of_zero" else topic.name  # the synchroniser knows streams, not topics
    bench.refused("reconstruction_node", sentence, where)
    views_arrive(bench, small_frames)


def test_image_and_camera_info_of_different_sizes_are_refused_and_good_views_still_arrive(bench, reconstruction, small_frames):
    frame = small_frames[0]
    bench.publish(messages.LEFT_INFO, messages.encode_camera_info(K, 640, 512, frame.stamp_ns, "endoscope_left"))
    bench.publish(messages.CAMERA_POSE, messages.encode_pose(frame.camera.pose, frame.stamp_ns, "world"))
    bench.publish(messages.LEFT_IMAGE, messages.encode_image(frame.image, frame.stamp_ns, "endoscope_left"))
    bench.until(lambda: reconstruction._synchronizer.pending)
    assert not bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.refused("reconstruction_node", "the image is 96×80 but camera_info says 640×512", "endoscope/left")
    views_arrive(bench, small_frames)


def test_no_images_within_the_timeout_is_a_warning_with_the_topic_until_views_come(bench, reconstruction, small_frames):
    assert bench.set("reconstruction_node", image_timeout=0.5)[0]
    bench.status("reconstruction_node", "no image on /endoscope/left/image_raw", WARN)
    views_arrive(bench, small_frames)
    assert reconstruction.status()[0] == OK


def test_images_that_never_become_views_are_a_warning_that_says_why(bench, reconstruction, small_frames):
    assert bench.set("reconstruction_node", image_timeout=0.5)[0]
    stamps = itertools.count(1)

    def warned():
        send_frames(bench, small_frames, next(stamps) * S, poses=False)
        return any("images arrive but none is usable" in text for _, text, _ in bench.statuses["reconstruction_node"])

    bench.until(warned, "a warning")
    assert "without pose" in bench.status("reconstruction_node", "images arrive but", WARN)[1]


def test_camera_info_of_another_size_in_mid_stream_is_followed(bench, reconstruction, small_frames):
    import cv2

    views_arrive(bench, small_frames)
    big = [f.__class__(f.stamp_ns, cv2.resize(f.image, (192, 160)), f.camera.resized(192, 160),
                       depth=cv2.resize(f.depth, (192, 160))) for f in small_frames]  # fmt: skip
    views_arrive(bench, big, shift_ns=3 * S, count=24)
    assert {frame.camera.width for frame in reconstruction._frames} == {96, 192}


def test_a_slow_recording_is_not_taken_for_one_that_ended(bench, reconstruction, small_frames):
    """Images every half second, with a silence of 0.2 s set to mean the end."""
    assert bench.set("reconstruction_node", start_after=0.2, image_timeout=4.0)[0]
    for count in range(1, 4):
        send_frames(bench, small_frames[count - 1 : count])
        bench.until(lambda: time.monotonic() - reconstruction._last_image > 0.5, "half a second")
        assert reconstruction._trained is None
    bench.status("reconstruction_node", "finished, model saved in")
    assert len(reconstruction._frames) == 3


def test_recording_is_reconstructed_published_latched_and_saved(bench, reconstruction, small_frames, tmp_path):
    # Iterations enough to outlast the publish period on the fastest machine.
    assert bench.set("reconstruction_node", publish_period=0.1, output_dir=str(tmp_path), keyframes=3, iterations=200)[0]
    models = bench.hear(messages.GAUSSIANS)
    refused = bench.call(Trigger, "/reconstruction_node/reconstruct")
    assert not refused.success and "no views yet" in refused.message
    assert not bench.call(Trigger, "/reconstruction_node/save").success
    send_frames(bench, small_frames)
    assert bench.set("reconstruction_node", start_after=0.3)[0]
    bench.status("reconstruction_node", "finished, model saved in")
    level, text, values = bench.statuses["reconstruction_node"][-1]
    assert level == OK and values["views"] == "12"
    saved = load_ply(next(tmp_path.glob("*/model.ply")))
    # The final model may come after the status, and behind more than one intermediate model.
    as_saved = lambda: len(saved) == len(newest := messages.decode_gaussians(models[-1])) and torch.allclose(saved.means, newest.means)
    bench.until(lambda: len(models) >= 2 and as_saved(), "an intermediate and the final model, which is the saved one")
    final = messages.decode_gaussians(models[-1])
    assert 100 < len(final) <= 1500 and len(list(tmp_path.glob("*/checkpoint.pt"))) == 1
    cameras = bench.hear(messages.TRAINING_CAMERAS)  # a late joiner
    bench.until(lambda: cameras, "the latched training cameras")
    assert cameras[-1].header.stamp == models[-1].header.stamp
    assert len(cameras[-1].poses) == 3
    count = len(models)
    time.sleep(0.5)  # nothing new came: nothing may be reconstructed again
    bench.until(lambda: not reconstruction._training)
    assert len(models) == count
    answer = bench.call(Trigger, "/reconstruction_node/save")
    assert answer.success and answer.message.startswith(str(tmp_path))
    # The newest model comes back by name, with the cameras that were saved beside it.
    assert bench.set("reconstruction_node", model_file="latest")[0]
    bench.until(lambda: len(models) > count, "the saved model")
    bench.until(lambda: cameras[-1].header.stamp == models[-1].header.stamp, "its cameras")
    torch.testing.assert_close(messages.decode_gaussians(models[-1]).means, final.means)
    assert len(cameras[-1].poses) == 3
    count = len(models)
    # A second recording with the very same stamps, after a pause, is another recording.
    bench.until(lambda: time.monotonic() - reconstruction._last_image > 1.1)
    send_frames(bench, small_frames)
    bench.until(lambda: len(models) > count, "a model of the second recording")
    assert len(reconstruction._frames) == 12
    assert messages.stamp_to_ns(models[-1].header.stamp) > messages.stamp_to_ns(models[count - 1].header.stamp)


def test_stamps_that_jump_begin_a_new_recording_and_looping_does_not_reconstruct_again(bench, reconstruction, small_frames, monkeypatch):
    # However long the training in between takes, the bag loops without a pause.
    monkeypatch.setattr(sys.modules[type(reconstruction).__module__], "_PAUSE", 60.0)
    long = [f.__class__(f.stamp_ns + i * S, f.image, f.camera, depth=f.depth) for i, f in enumerate(small_frames)]
    send_frames(bench, long)
    send_frames(bench, long[:6])  # the bag starts again
    bench.until(lambda: reconstruction._trained is not None, "training at the end of the loop")
    trained = reconstruction._trained
    assert trained == (long[0].stamp_ns, long[-1].stamp_ns)
    send_frames(bench, long[6:])
    bench.until(lambda: not reconstruction._training)
    send_frames(bench, long[:2])
    bench.until(lambda: len(reconstruction._frames) <= 2)
    assert not reconstruction._training and reconstruction._trained == trained
    send_frames(bench, small_frames[:4], 3600 * S)  # an hour later
    reconstruction._flush()
    assert len(reconstruction._frames) == 4


def test_a_live_camera_is_reconstructed_once_when_enough_views_came(bench, reconstruction, small_frames):
    assert bench.set("reconstruction_node", start_views=6, iterations=5)[0]
    for index, shift in enumerate((0, S, 2 * S)):
        send_frames(bench, small_frames, shift)
        bench.until(lambda: reconstruction._trained is not None and not reconstruction._training)
    assert reconstruction._trained[1] < small_frames[0].stamp_ns + S  # not again with the views after the first six


def test_a_place_that_cannot_be_written_is_told_and_the_model_is_published_all_the_same(bench, reconstruction, small_frames, tmp_path):
    models = bench.hear(messages.GAUSSIANS)
    assert bench.set("reconstruction_node", output_dir="/proc/nowhere", iterations=5)[0]
    send_frames(bench, small_frames)
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.refused("reconstruction_node", "the model cannot be saved", "/proc/nowhere", "set output_dir")
    bench.until(lambda: models and not reconstruction._training, "the model, and the end of its training")
    assert reconstruction.status()[0] == ERROR  # still
    assert "cannot be saved" in bench.call(Trigger, "/reconstruction_node/save").message
    assert bench.set("reconstruction_node", output_dir=str(tmp_path))[0]
    assert bench.call(Trigger, "/reconstruction_node/save").success
    assert list(tmp_path.glob("*/model.ply"))


def test_a_reconstruction_that_fails_says_so_until_the_next_one(bench, reconstruction, small_frames):
    dark = [f.__class__(f.stamp_ns, f.image, f.camera, mask=np.zeros((80, 96), np.uint8)) for f in small_frames]
    for frame in dark:
        bench.publish(messages.MASK, messages.encode_image(frame.mask, frame.stamp_ns, "endoscope_left"))
    bench.until(lambda: len(reconstruction._synchronizer._streams["mask"].stamps) == 12)
    send_frames(bench, small_frames)
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.refused("reconstruction_node", "every pixel of every view is masked")
    bench.until(lambda: not reconstruction._training)
    assert reconstruction.status()[0] == ERROR
    views_arrive(bench, small_frames, 100 * S)
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.status("reconstruction_node", "finished")


def test_services_answer_and_callbacks_stay_quick_while_training(bench, reconstruction, small_frames):
    send_frames(bench, small_frames)
    assert bench.set("reconstruction_node", iterations=10_000)[0]
    assert bench.call(Trigger, "/reconstruction_node/reconstruct").success
    bench.until(lambda: reconstruction._progress is not None, "progress")
    again = bench.call(Trigger, "/reconstruction_node/reconstruct")
    assert not again.success and "a reconstruction is running: training, iteration" in again.message
    start = time.monotonic()
    send_frames(bench, small_frames, 2 * S)
    bench.until(lambda: len(reconstruction._frames) >= 20, "views during training")
    assert time.monotonic() - start < 5.0
    iteration = bench.status("reconstruction_node", "training, iteration", OK)[2]["iteration"]
    assert 0 < int(iteration) < 10_000
    reconstruction._cancel.set()
    bench.until(lambda: not reconstruction._training, "the training to stop")


def test_a_model_file_is_published_when_set_and_a_bad_one_is_refused_with_the_reason(bench, reconstruction, tmp_path):
    models = bench.hear(messages.GAUSSIANS)
    ok, reason = bench.set("reconstruction_node", model_file=str(tmp_path / "missing.ply"))
    assert not ok and "missing.ply: no such file" in reason
    save_ply(sheet(5), tmp_path / "model.ply")
    assert bench.set("reconstruction_node", model_file=str(tmp_path / "model.ply"))[0]
    bench.until(lambda: models, "the model of the file")
    assert len(messages.decode_gaussians(models[0])) == 25


def test_a_model_file_needs_no_image_and_a_recording_may_still_come(bench, reconstruction, small_frames, tmp_path):
    save_ply(sheet(5), tmp_path / "model.ply")
    assert bench.set("reconstruction_node", image_timeout=0.1, model_file=str(tmp_path / "model.ply"))[0]
    bench.until(lambda: time.monotonic() - reconstruction._last_view > 0.2, "a long silence")
    said = len(bench.statuses["reconstruction_node"])
    assert bench.status("reconstruction_node", f"published the model of {tmp_path}/model.ply", OK, said)[2]["gaussians"] == "25"
    send_frames(bench, small_frames, poses=False)
    for _ in range(2):  # images without poses are given up when later ones come
        reconstruction._flush()
        bench.status("reconstruction_node", "images arrive but none is usable", WARN)
    views_arrive(bench, small_frames)


# ------------------------------------------------------------------------------------------------------- physics


@pytest.fixture
def physics(bench):
    bench.hear(messages.CONTROL_NODES)
    return bench.add(PhysicsNode)


def cloud(change=lambda message: None, model=None):
    message = messages.encode_gaussians(sheet(8) if model is None else model, 5 * S, "world")
    change(message)
    return message


def truncate(message):
    message.data = message.data[:-100]


def drop_field(message):
    message.fields = [field for field in message.fields if field.name != "opacity"]


def not_finite():
    model = sheet(8)
    model.means[7, 1] = float("nan")
    return cloud(model=model)


BAD_MODELS = {
    "empty_cloud": (lambda: cloud(model=sheet(8).select(torch.zeros(0, dtype=int))), "the model is empty"),
    "truncated_cloud": (lambda: cloud(truncate), "the cloud is truncated"),
    "missing_field": (lambda: cloud(drop_field), "missing field opacity"),
    "non_finite_mean": (not_finite, "means of Gaussian 7 is not finite"),
    "unknown_frame": (lambda: cloud(lambda m: setattr(m.header, "frame_id", "map")), "unknown frame 'map'"),
}


@pytest.mark.parametrize("name", BAD_MODELS)
def test_bad_model_is_one_sentence_for_physics_and_rendering_and_a_good_one_still_works(bench, physics, name):
    bench.add(RenderingNode)
    bench.hear(messages.RENDERED_IMAGE)
    make, sentence = BAD_MODELS[name]
    bench.publish(messages.GAUSSIANS, make())
    for node in ("physics_node", "rendering_node"):
        bench.refused(node, sentence, "gaussians")
    send_model(bench, stamp=6 * S)
    send_camera(bench)
    await_nodes(bench, 6 * S)
    await_image(bench, lambda image: image.max() > 100, "tissue in the picture")


def test_a_model_that_cannot_be_made_soft_says_so_until_a_better_one_comes(bench, physics):
    send_model(bench, sheet(8).select(torch.arange(2)), stamp=5 * S)
    bench.refused("physics_node", "tissue needs at least 4", "physics")
    bench.until(lambda: physics._failure)
    assert physics.status()[0] == ERROR
    send_model(bench, stamp=6 * S)
    await_nodes(bench, 6 * S)
    assert physics.status()[0] == OK


BAD_WRENCHES = {
    "nan": (dict(force=(float("nan"), 0, 0)), "the wrench is not finite"),
    "infinite": (dict(force=(0, float("inf"), 0)), "the wrench is not finite"),
    "unknown_frame": (dict(force=(0, 0, 1.0), frame="tool0"), "unknown frame 'tool0'"),
}


@pytest.mark.parametrize("name", BAD_WRENCHES)
def test_bad_wrench_is_one_sentence_and_a_good_one_still_moves_tissue(bench, physics, name):
    fields, sentence = BAD_WRENCHES[name]
    send_model(bench)
    await_nodes(bench, 5 * S)
    send_tip(bench)
    send_wrench(bench, **fields)
    bench.refused("physics_node", sentence, "PSM1/body/servo_cf")
    assert moved(bench) == 0
    pull(bench, lambda: moved(bench) > 1e-3)


def test_a_wrench_or_jaw_before_any_pose_is_one_sentence(bench, physics):
    send_wrench(bench, (0, 0, 1.0))
    bench.refused("physics_node", "a wrench came before any pose on PSM1/measured_cp", "PSM1/body/servo_cf")
    bench.publish(messages.tool_jaw("PSM2"), messages.encode_jaw(0.0, S))
    bench.refused("physics_node", "a jaw command came before any pose on PSM2/measured_cp")
    send_model(bench)
    await_nodes(bench, 5 * S)
    pull(bench, lambda: moved(bench) > 1e-3)


def test_an_absurd_wrench_is_undone_and_told_and_a_moderate_one_still_works(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    for force in (1e6, 1e30, 1e300):
        said = len(bench.statuses["physics_node"])
        pull(bench, lambda: any(s[0] == ERROR for s in bench.statuses["physics_node"][said:]), (0, 0, force))
        assert np.isfinite(nodes_of(bench).positions).all() and moved(bench) < 0.06
    send_wrench(bench, (0, 0, 0))
    bench.until(lambda: moved(bench) < 1e-3, "the tissue to come back")
    pull(bench, lambda: moved(bench) > 1e-3)


def test_a_wrench_in_the_air_says_that_it_has_no_effect(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    for position in ((0, 0, -5.0), (1e30, 0, 0)):
        pull(bench, lambda: any("has no effect" in s[1] for s in bench.statuses["physics_node"]), position=position)
        assert moved(bench) == 0
    bench.refused("physics_node", "has no effect", "force_radius", "PSM1")


def test_two_arms_act_and_each_hears_its_own_reaction(bench, physics):
    reactions = bench.hear(messages.tool_reaction("PSM1")), bench.hear(messages.tool_reaction("PSM2"))
    send_model(bench)
    await_nodes(bench, 5 * S)

    def both():
        send_tip(bench, (0.02, 0, 0.1), "PSM1")
        send_tip(bench, (-0.02, 0, 0.1), "PSM2")
        send_wrench(bench, (0, 0, -0.5), "PSM1")
        send_wrench(bench, (0, 0, 0.25), "PSM2", frame="PSM2")
        for _ in range(10):
            bench.executor.spin_once(timeout_sec=0.005)
        newest = [messages.decode_wrench(heard[-1], "")[0][2] if heard else 0.0 for heard in reactions]
        return np.allclose(newest, [0.5, -0.25], atol=1e-3)

    bench.until(both, "minus the wrenches as reactions")
    bench.until(lambda: moved(bench) < 1e-4, "the tissue to be released after command_timeout")


def test_a_rigid_tool_pushes_the_tissue_and_feels_it(bench, physics):
    reactions = bench.hear(messages.tool_reaction("PSM1"))
    send_model(bench)
    await_nodes(bench, 5 * S)
    assert bench.set("physics_node", contact_radius=0.015, friction=0.1)[0]
    bench.until(lambda: physics._simulation.contact_radius >= 0.015)

    def feels():
        send_tip(bench, (0, 0, 0.09), "PSM1")
        bench.spin(0.03)
        return reactions and messages.decode_wrench(reactions[-1], "")[0][2] < -0.02 and moved(bench) > 1e-3

    bench.until(feels, "the tissue to be pushed away from the camera, and to push back")
    assert physics._simulation.faults == 0


def test_what_cannot_be_cut_says_so_and_the_tool_goes_on(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    bench.publish(messages.tool_cut("PSM1"), messages.encode_cut(True, S))
    bench.refused("physics_node", "PSM1/cut: a cut came before any pose on PSM1/measured_cp")
    message = messages.encode_cut(True, S)
    message.buttons = []
    bench.publish(messages.tool_cut("PSM1"), message)
    bench.refused("physics_node", "PSM1/cut: expected a button")
    assert bench.set("physics_node", kinematics="current")[0]
    bench.until(lambda: physics._simulation.config.kinematics == "current")
    send_tip(bench, (0, 0, 0.1), "PSM1")
    bench.until(lambda: physics._arms["PSM1"].pose is not None)
    bench.publish(messages.tool_cut("PSM1"), messages.encode_cut(True, S))
    bench.refused("physics_node", "kinematics current cannot be cut; set kinematics to rest")
    pull(bench, lambda: moved(bench) > 1e-3)


def test_services_in_every_state(bench, physics):
    call = lambda name: bench.call(Trigger, f"/physics_node/{name}")  # noqa: E731
    for name in ("reset", "step"):
        answer = call(name)
        assert not answer.success and answer.message == "there is no model yet"
    send_model(bench)
    await_nodes(bench, 5 * S)
    assert "running; call ~/pause with true first" in call("step").message
    pull(bench, lambda: moved(bench) > 1e-3)
    assert bench.call(SetBool, "/physics_node/pause", data=True).message == "paused"
    before = physics._simulation.time
    assert call("step").message == f"time {before + 0.02:.4f} s"
    assert call("reset").success and physics._simulation.time == 0
    bench.until(lambda: moved(bench) == 0, "the tissue at rest")
    assert bench.call(SetBool, "/physics_node/pause", data=False).success
    bench.until(lambda: physics._simulation.time > 0.05, "time to go on")


def test_a_model_without_training_cameras_is_seen_from_where_the_camera_is(bench, physics):
    send_model(bench, cameras=None)
    bench.status("physics_node", "waiting for training_cameras or ECM/measured_cp", WARN)
    send_camera_pose = messages.encode_pose(np.eye(4), S, "world")
    bench.publish(messages.CAMERA_POSE, send_camera_pose)
    await_nodes(bench, 5 * S)
    send_model(bench, stamp=6 * S, cameras=())  # an empty PoseArray
    await_nodes(bench, 6 * S)
    bench.publish(messages.GAUSSIANS, cloud(lambda m: setattr(m.header.stamp, "sec", 9)))  # cameras stay those of 6
    await_nodes(bench, 9 * S)


def test_tissue_is_left_out_where_the_training_cameras_see_through_it(bench, physics):
    """A small plate in front of a wide one, seen from both sides."""
    rng = np.random.default_rng(7)
    plates = [np.c_[rng.uniform(-half, half, (count, 2)), np.full(count, z)] for half, z, count in ((0.02, 0.1, 1000), (0.06, 0.16, 3000))]
    points = torch.from_numpy(np.concatenate(plates)).float()
    model = GaussianModel.from_points(points, torch.full((len(points), 3), 0.5), torch.full((len(points),), 0.003), opacity=0.95)
    poses = [make_pose(np.array([x, 0, 0]), np.array([1.0, 0, 0, 0])) for x in (-0.06, 0, 0.06)]
    bench.hear(messages.CONTROL_NODES)
    bench.publish(messages.TRAINING_CAMERA_INFO, messages.encode_camera_info(K, WIDTH, HEIGHT, 5 * S, "endoscope_left"))
    send_model(bench, model, cameras=poses)
    cameras = [Camera(K, WIDTH, HEIGHT, pose) for pose in poses]
    carved, whole = (build_control_nodes(model, np.stack(poses)[:, :3, 3], physics._config, seen) for seen in (cameras, ()))
    assert len(carved) < len(whole)
    np.testing.assert_array_equal(await_nodes(bench, 5 * S).rest, carved.rest.astype(np.float32))


def test_a_new_model_replaces_the_old_one_while_it_is_touched(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    pull(bench, lambda: moved(bench) > 1e-3)
    send_model(bench, sheet(z=0.12), stamp=6 * S)
    pull(bench, lambda: nodes_of(bench).model_stamp_ns == 6 * S, position=(0, 0, 0.12), what="the new model")
    assert nodes_of(bench).rest[:, 2].min() > 0.11
    pull(bench, lambda: moved(bench) > 1e-3, position=(0, 0, 0.12), what="the new tissue to move")


def test_models_with_equal_or_zero_stamps_replace_each_other_too(bench, physics):
    bench.add(RenderingNode)
    bench.hear(messages.RENDERED_DEPTH)
    send_camera(bench)

    def depth():
        heard = bench.heard["rendered/depth/image"]
        return messages.decode_depth(heard[-1])[40, 48] if heard else 0

    for z in (0.1, 0.13, 0.16):
        send_model(bench, sheet(z=z), stamp=0)
        bench.until(lambda: bench.heard["control_nodes"] and abs(nodes_of(bench).rest[:, 2].min() - z) < 1e-3, f"nodes at {z}")
        bench.until(lambda: abs(depth() - z) < 0.005, f"a picture of the model at {z}")


def test_poses_in_the_frame_of_a_robots_base_are_turned_into_the_world(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    for wrong in (["base 0 0 0.1"], ["base 0 0 0.1 0 0 0 2"], ["base 0 0 nan 0 0 0 1"]):
        successful, reason = bench.set("physics_node", frames=wrong)
        assert not successful and "frames: 'base" in reason
    half = 0.5**0.5
    assert bench.set("physics_node", frames=[f"base 0 0 0.1 0 {half} 0 {half}"])[0]  # its z axis is the world's x axis
    bench.publish(messages.tool_pose("PSM1"), messages.encode_pose(np.eye(4), S, "base"))
    send_wrench(bench, (0, 0, 1.0), frame="base")
    bench.until(lambda: moved(bench) > 5e-4, "tissue to move")
    state = nodes_of(bench)
    shift = state.positions - state.rest
    assert shift[np.linalg.norm(shift, axis=1).argmax()].argmax() == 0  # along the world's x
    arm = physics._arms["PSM1"]
    for base, z in (("PSM2_base", 0.0), ("PSM1_base", 0.2)):  # a pose without a frame is in that of the arm, or in the world
        assert bench.set("physics_node", frames=[f"{base} 0 0 0.2 0 0 0 1"])[0]
        bench.publish(messages.tool_pose("PSM1"), messages.encode_pose(np.eye(4), S, ""))
        bench.until(lambda: arm.pose[2, 3] == z, f"a tip at {z} m")
    assert bench.set("physics_node", frames=["base 0 0 0.1 0 0 0 1"])[0]
    bench.publish(messages.tool_pose("PSM1"), messages.encode_pose(np.eye(4), S, "elsewhere"))
    bench.refused("physics_node", "unknown frame 'elsewhere'; this graph knows 'world' or 'base'")


def test_physics_follows_a_simulated_clock(bench):
    clock = messages.encode_clock
    bench.hear(messages.CONTROL_NODES)
    node = bench.add(PhysicsNode)
    assert bench.set("physics_node", use_sim_time=True)[0]
    bench.publish(messages.CLOCK, clock(100 * S))
    send_model(bench)
    bench.until(lambda: node._simulation is not None, "the simulation")
    for k in range(100):  # a second of simulated time, however long it takes
        bench.publish(messages.CLOCK, clock(100 * S + k * S // 100))
        bench.spin(0.01)
    bench.spin(0.2)
    assert len(bench.heard["control_nodes"]) == pytest.approx(1 / node._simulation.step_duration, abs=2)
    assert node._simulation.time == pytest.approx(1.0, abs=2 * node._simulation.step_duration)
    assert messages.stamp_to_ns(bench.heard["control_nodes"][-1].header.stamp) <= 101 * S
    bench.publish(messages.CLOCK, clock(5 * S))  # another bag: the clock begins anew, and so does the rhythm
    count = len(bench.heard["control_nodes"])
    for k in range(20):
        bench.publish(messages.CLOCK, clock(5 * S + k * S // 100))
        bench.spin(0.01)
    assert len(bench.heard["control_nodes"]) >= count + 5


def test_overloaded_physics_acts_on_the_newest_command(bench, physics, monkeypatch):
    """Each step takes longer than it should, and meanwhile three commands come, numbered by their force in millinewtons."""
    send_model(bench)
    await_nodes(bench, 5 * S)
    send_tip(bench)
    arm = physics._arms["PSM1"]
    bench.until(lambda: arm.pose is not None, "a tip")
    sent, delays, step = 1, [], physics._step

    def slow(simulation):
        nonlocal sent
        if arm.force is not None:
            delays.append(sent - round(-1e3 * arm.force[2]))
        step(simulation)
        for _ in range(3):
            sent += 1
            send_wrench(bench, (0, 0, -1e-3 * sent))
            time.sleep(0.03)

    send_wrench(bench, (0, 0, -1e-3))
    monkeypatch.setattr(physics, "_step", slow)
    bench.until(lambda: len(delays) > 15, "steps", 60)
    assert max(delays) <= 6, delays  # the newest that had arrived: what is sent last may still be on its way


def test_parameters_act_or_are_refused_with_the_reason(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    for name, value, reason in (
        ("young_modulus", 5000, "expected 'Type.DOUBLE' got 'Type.INTEGER'"),
        ("young_modulus", -1.0, "out of range"),
        ("young_modulus", float("nan"), "out of range"),
        ("material", "jelly", "must be one of fixed_corotated, neo_hookean, got 'jelly'"),
        ("device", "tpu", "unknown device 'tpu'"),
        ("arms", ["PSM3"], "arms: read at start only; restart the node"),
        ("regions", ["sphere 0 0"], "region 'sphere 0 0': a sphere takes 4 values"),
    ):
        successful, text = bench.set("physics_node", **{name: value})
        assert not successful and reason in text, (name, value, text)
    assert bench.set("physics_node", arms=["PSM1", "PSM2"])[0]  # as it is already
    assert bench.set("physics_node", young_modulus=5000.0)[0]
    bench.until(lambda: physics._simulation.config.young_modulus == 5000.0, "softer tissue")
    painted = ["sphere 0 0 0.1 0.02 young_modulus=20000"]
    assert bench.set("physics_node", regions=painted)[0]
    bench.until(lambda: physics._simulation.config.regions == tuple(painted), "a stiffer region")
    assert bench.set("physics_node", regions=[""])[0]
    bench.until(lambda: physics._simulation.config.regions == ("",), "no region")
    assert bench.set("physics_node", adapt_substeps=False, substeps=100_000, substep_dt=0.1)[0]  # far too long for the material
    bench.refused("physics_node", "substep")
    count = len(bench.heard["control_nodes"])
    assert bench.set("physics_node", adapt_substeps=True, substeps=80, substep_dt=0.0005)[0]
    bench.until(lambda: len(bench.heard["control_nodes"]) > count + 5 and not physics._failure, "steps to go on")


def test_errors_at_500_hz_flood_neither_the_log_nor_diagnostics_nor_memory(bench, physics):
    logged = []
    physics.get_logger = lambda: type("Logger", (), {"error": staticmethod(logged.append)})
    for number in range(1000):  # every text is different
        physics.report_error(f"error {number}")
    assert len(logged) == _MOST_LOGGED == len(physics._logged)
    bench.until(lambda: any(s[2]["errors"] == "1000" for s in bench.statuses["physics_node"]), "the count of errors")
    assert len(bench.statuses["physics_node"]) < _MOST_LOGGED + 10
    assert bench.statuses["physics_node"][-1][1] == "error 999"
    physics.report_error("x" * 2_000_000)  # a frame_id of that length, quoted
    bench.until(lambda: 1000 < len(bench.statuses["physics_node"][-1][1]) < 1010, "the beginning of a long error")


# ----------------------------------------------------------------------------------------------------- rendering


@pytest.fixture
def rendering(bench):
    bench.hear(messages.RENDERED_IMAGE)
    return bench.add(RenderingNode)


def bad_camera(**changes):
    message = messages.encode_camera_info(K, WIDTH, HEIGHT, S, "endoscope_left")
    for name, value in changes.items():
        setattr(message, name, value)
    return messages.LEFT_INFO, message


BAD_CAMERAS = {
    "zero_K": (lambda: bad_camera(k=np.zeros(9)), "the camera is not calibrated"),
    "no_size": (lambda: bad_camera(width=0), "the image size is 0×80"),
    "absurd_size": (lambda: bad_camera(width=4_000_000_000), "too large to render"),
    "non_finite_pose": (lambda: BAD_RECORDINGS["non_finite_pose"][0](_Posed), "the pose is not finite"),
    "non_unit_pose": (lambda: BAD_RECORDINGS["non_unit_pose"][0](_Posed), "normalise it"),
    "unknown_frame": (lambda: BAD_RECORDINGS["unknown_frame"][0](_Posed), "unknown frame 'base_link'"),
}


class _Posed:
    stamp_ns = S

    class camera:  # noqa: N801
        pose = np.eye(4)


@pytest.mark.parametrize("name", BAD_CAMERAS)
def test_bad_camera_is_one_sentence_and_a_good_one_still_renders(bench, rendering, name):
    send_model(bench)
    make, sentence = BAD_CAMERAS[name]
    topic, message = make()
    bench.publish(topic, message)
    bench.refused("rendering_node", sentence, topic.name)
    send_camera(bench)
    assert await_image(bench, lambda image: image.max() > 100).shape == (HEIGHT, WIDTH, 3)


def test_control_nodes_that_are_damaged_or_of_another_model_leave_the_picture_alone(bench, rendering):
    send_model(bench)
    send_camera(bench)
    at_rest = await_image(bench, lambda image: image.max() > 100)
    rest = sheet(8).means.numpy()
    F = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))

    def state(stamp, positions):
        return messages.encode_control_nodes(messages.ControlNodeCloud(rest, positions, F, stamp), S, "world")

    damaged = state(5 * S, rest)
    truncate(damaged)
    lacking = state(5 * S, rest)
    lacking.fields = lacking.fields[:5]
    for message, sentence in (
        (damaged, "the cloud is truncated"),
        (lacking, "missing field rest_z"),
        (state(5 * S, rest * np.nan), "a control node is not finite"),
    ):
        bench.publish(messages.CONTROL_NODES, message)
        bench.refused("rendering_node", sentence, "control_nodes")
    count = len(bench.heard["rendered/image_raw"])
    bench.publish(messages.CONTROL_NODES, state(4 * S, rest + np.float32(0.02)))
    bench.until(lambda: len(bench.heard["rendered/image_raw"]) > count + 3, "more pictures")
    assert np.array_equal(newest_image(bench), at_rest)
    bench.publish(messages.CONTROL_NODES, state(5 * S, rest + np.float32(0.02)))
    await_image(bench, lambda image: np.abs(image - at_rest).max() > 50, "the tissue to move with its nodes")
    assert bench.status("rendering_node", "rendering", OK)


def test_extreme_nodes_and_poses_do_not_end_the_node(bench, rendering):
    send_model(bench)
    send_camera(bench)
    await_image(bench, lambda image: image.max() > 100)
    rest = sheet(8).means.numpy()
    for scale in (1e-30, 1e10, 1e30):
        F = np.full((len(rest), 3, 3), scale, np.float32)
        cloud = messages.ControlNodeCloud(rest, (rest * np.float32(scale)), F, 5 * S)
        bench.publish(messages.CONTROL_NODES, messages.encode_control_nodes(cloud, S, "world"))
        far = np.eye(4)
        far[:3, 3] = scale
        send_camera(bench, far)
        count = len(bench.heard["rendered/image_raw"])
        bench.until(lambda: len(bench.heard["rendered/image_raw"]) > count + 2, f"pictures at {scale}")
    F = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))
    cloud = messages.ControlNodeCloud(rest, rest, F, 5 * S)
    bench.publish(messages.CONTROL_NODES, messages.encode_control_nodes(cloud, S, "world"))
    send_camera(bench)
    await_image(bench, lambda image: image.max() > 100, "the tissue again")


def test_the_picture_follows_camera_info_pose_and_parameters(bench, rendering):
    send_model(bench)
    send_camera(bench)
    first = await_image(bench, lambda image: image.max() > 100)
    send_camera(bench, width=48, height=40)
    await_image(bench, lambda image: image.shape == (40, 48, 3), "the size of the new camera_info")
    aside = np.eye(4)
    aside[0, 3] = 0.03
    send_camera(bench, aside)
    await_image(bench, lambda image: image.shape == first.shape and np.abs(image - first).max() > 50, "the new pose")
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    send_camera(bench, away)
    await_image(bench, lambda image: image.max() == 0, "nothing behind the camera")
    assert bench.set("rendering_node", background=1.0)[0]
    await_image(bench, lambda image: image.min() == 255, "a white background")
    assert bench.set("rendering_node", image_width=32)[0]
    await_image(bench, lambda image: image.shape[1] == 32, "the width asked for")
    assert not bench.set("rendering_node", device="cuda:99")[0]


def test_images_bear_the_stamp_of_the_state_that_they_show(bench, rendering):
    infos, poses, depths = (bench.hear(topic) for topic in messages.RENDERED_TOPICS if topic != messages.RENDERED_IMAGE)
    images = bench.heard["rendered/image_raw"]
    stamp_of = lambda message: messages.stamp_to_ns(message.header.stamp)  # noqa: E731
    send_model(bench)
    send_camera(bench)
    await_image(bench, lambda image: image.max() > 100)
    rest = sheet(8).means.numpy()
    F = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))

    def shown(shift, stamp):
        """Stamp of the first image of this state."""
        before = newest_image(bench)
        cloud = messages.ControlNodeCloud(rest, rest + np.float32([shift, 0, 0]), F, 5 * S)
        count = len(images)
        bench.publish(messages.CONTROL_NODES, messages.encode_control_nodes(cloud, stamp, "world"))

        def first():
            new = [image for image in images[count:] if np.abs(messages.decode_image(image).astype(int) - before).max() > 50]
            return new and stamp_of(new[0])

        return bench.until(first, "an image of the state")

    shown(0.01, rendering.now_ns())  # from now on the renderer is bound to the nodes
    bench.until(lambda: rendering.status()[2]["following control nodes"], "the renderer to follow")
    assert bench.set("rendering_node", idle_rate=0.1)[0]  # nothing in between
    for shift in (0.02, 0.03):
        bench.spin(0.1)
        taken = rendering.now_ns()
        bench.spin(0.2)  # on its way
        assert shown(shift, taken) == taken
    moved_at = rendering.now_ns()
    aside = np.eye(4)
    aside[0, 3] = 0.03
    send_camera(bench, aside)
    await_image(bench, lambda _: stamp_of(images[-1]) > moved_at, "an image of the moved camera, of the time when it is shown")
    assert shown(0.0, moved_at - S) > moved_at, "no stamp goes back"
    assert shown(0.02, rendering.now_ns() + 100 * S) < rendering.now_ns(), "a clock that is ahead is not believed"
    assert bench.set("rendering_node", idle_rate=20.0)[0]
    count = len(images)
    bench.until(lambda: len(images) > count + 3, "the same again")
    stamps = [stamp_of(image) for image in images]
    assert stamps == sorted(set(stamps))
    bench.until(lambda: len(poses) == len(infos) == len(images) and stamp_of(depths[-1]) == stamp_of(images[-1]))
    assert stamps == [stamp_of(info) for info in infos][: len(stamps)] == [stamp_of(pose) for pose in poses][: len(stamps)]


def test_training_cameras_are_used_until_a_camera_comes(bench, rendering):
    bench.status("rendering_node", "waiting for a model", WARN)
    send_model(bench)
    bench.status("rendering_node", "waiting for a camera", WARN)
    info = messages.encode_camera_info(K, WIDTH, HEIGHT, 5 * S, "endoscope_left")
    bench.publish(messages.TRAINING_CAMERA_INFO, info)
    poses, infos = bench.hear(messages.RENDERED_POSE), bench.hear(messages.RENDERED_INFO)
    image = await_image(bench, lambda image: image.max() > 100)
    assert image.shape == (HEIGHT, WIDTH, 3)
    bench.until(lambda: poses and infos)
    stamps = {messages.stamp_to_ns(m.header.stamp) for m in bench.heard["rendered/image_raw"]}
    assert messages.stamp_to_ns(poses[0].header.stamp) in stamps and infos[0].width == WIDTH


# ------------------------------------------------------------------------------------ recorder, player and tool


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
    bench.refused("recorder", "recording stopped", "No space left on device")
    for number in range(50):
        send_wrench(bench, (0, 0, 1.0), stamp=S + number)
        bench.executor.spin_once(timeout_sec=0.01)
    bench.until(lambda: recorder._dropped >= 50, "messages to be dropped")
    assert recorder._queue.qsize() < 3 and recorder.status()[0] == ERROR


def test_a_recorder_keeps_what_was_said_and_refuses_to_overwrite(bench, recording):
    recorder = bench.add(RecorderNode)
    send_wrench(bench, (1.0, 2.0, 3.0))
    bench.until(lambda: recorder._written >= 2, "messages to be written")
    bench.executor.remove_node(recorder)
    bench.nodes.remove(recorder)
    recorder.destroy_node()
    with BagReader(recording) as bag:
        ((topic, _, message),) = bag.messages([messages.tool_wrench("PSM1")])
    assert message.wrench.force.y == 2.0
    bench.add(RecorderNode)
    bench.refused("recorder", "exists already")


def test_scripted_tool_waits_then_pulls_and_lets_go(bench, physics, rendering):
    tool = bench.add(ScriptedToolNode)
    bench.status("scripted_tool", "waiting for the rendered depth", WARN)
    assert bench.set("scripted_tool", pull=0.5, swing=0.5, release=0.2, force=1.0)[0]
    assert not bench.set("scripted_tool", arm="PSM2")[0]
    send_model(bench)
    send_camera(bench)
    await_nodes(bench, 5 * S)
    bench.until(lambda: moved(bench) > 1e-3, "the tool to move tissue")
    bench.status("scripted_tool", "finished", OK)
    assert np.linalg.norm(tool._tip - [0, 0, 0.1]) < 0.01
    bench.until(lambda: moved(bench) < 1e-4, "the tissue to be released")


def test_rendered_tissue_follows_a_wrench_and_comes_back(bench, physics, rendering):
    send_model(bench, sheet(tilt=0.3))
    send_camera(bench)
    await_nodes(bench, 5 * S)
    bench.status("rendering_node", "rendering", OK)
    bench.until(lambda: rendering.status()[2]["following control nodes"], "the renderer to follow the nodes")
    at_rest = await_image(bench, lambda image: image.max() > 100)
    pull(bench, lambda: np.abs(newest_image(bench) - at_rest).max() > 30, (0.8, 0, -1.5), what="pixels to change")
    await_image(bench, lambda image: np.abs(image - at_rest).max() < 12, "the tissue to come back")


# ----------------------------------------------------------------------------------------------------- processes


@pytest.fixture
def graph(tmp_path):
    with NodeGroup(tmp_path / "logs") as group:
        yield group


def log_of(node):
    return node.log.read_text()


def test_wrong_parameters_at_start_end_the_node_with_one_line(graph):
    wrong = {
        "physics_node": (("-p", "young_modulus:=5000"), "young_modulus must be a float, with a decimal point"),
        "rendering_node": (("-p", "device:=tpu"), "unknown device 'tpu'"),
        "recorder_node": (("-p", "arms:=['PSM 1']"), "'PSM 1' cannot name topics"),
        "bag_player_node": (("-p", "nonsense"), "nonsense"),
    }
    nodes = {graph.start(name, *arguments): sentence for name, (arguments, sentence) in wrong.items()}
    for node, sentence in nodes.items():
        assert node.wait(30) == 2
        assert sentence in log_of(node) and "Traceback" not in log_of(node)


def test_unknown_parameters_are_told_with_the_nearest_name_and_the_node_lives(bench, graph, tmp_path):
    params = tmp_path / "params.yaml"
    general = "/**: {ros__parameters: {idle_rate: 2.0, plugh: 1}}"  # the first is rendering_node's
    params.write_text(f"{general}\n/**/physics_node: {{ros__parameters: {{node_count: 200, xyzzy: 1}}}}")
    rclpys = {"use_sim_time": "false", "start_type_description_service": "true", "qos_overrides./clock.subscription.depth": 5}
    known = [word for name, value in rclpys.items() for word in ("-p", f"{name}:={value}")]
    node = graph.start("physics_node", "--params-file", str(params), *known, yuong_modulus=5000.0)
    sentence = "unknown parameters plugh, xyzzy, yuong_modulus (did you mean young_modulus?)"
    _, text, _ = bench.status("physics_node", sentence, WARN)
    assert text == f"waiting for a model on gaussians; {sentence}"
    assert log_of(node).count(sentence) == 1 and "[WARN]" in log_of(node)
    assert bench.set("physics_node", young_modulus=6000.0)[0]


def test_every_node_ends_by_sigterm_within_seconds_and_without_a_traceback(bench, graph, tmp_path):
    names = ("reconstruction_node", "physics_node", "rendering_node", "recorder_node", "bag_player_node")
    parameters = {"recorder_node": {"bag": tmp_path / "bag"}, "bag_player_node": {"bag": tmp_path / "none"}}
    for name in (*names, "scripted_tool_node"):
        graph.start(name, **parameters.get(name, {}))
    for name in (*names[:3], "recorder", "bag_player", "scripted_tool"):
        bench.until(lambda: bench.statuses[name], f"a word of {name}", 40)
    start = time.monotonic()
    for node in graph.nodes.values():
        node.send_signal(signal.SIGTERM)
    assert [node.wait(10) for node in graph.nodes.values()] == [0] * 6
    assert time.monotonic() - start < 6
    for node in graph.nodes.values():
        assert "Traceback" not in log_of(node)
    with BagReader(tmp_path / "bag") as bag:  # what was heard before the end is there
        assert "/diagnostics" in bag.topics


def test_unreadable_bags_are_told_by_players_that_live_on_each_in_its_namespace(bench, small_bag, tmp_path):
    (tmp_path / "truncated.mcap").write_bytes(next(small_bag.glob("*.mcap")).read_bytes()[:5000])
    (tmp_path / "foreign.mcap").write_text("not a bag")
    sentences = {"missing": "no such bag", "truncated": "the bag cannot be read", "foreign": "the bag cannot be read"}
    with NodeGroup(tmp_path / "a") as a, NodeGroup(tmp_path / "b") as b, NodeGroup(tmp_path / "c") as c:
        players = {
            name: group.start("bag_player_node", "-r", f"__ns:=/{name}", bag=tmp_path / f"{name}.mcap")
            for group, name in zip((a, b, c), sentences)
        }
        for name, sentence in sentences.items():
            bench.refused(f"{name}/bag_player", sentence, f"{name}.mcap")
            assert players[name].exit_status is None


def test_two_graphs_in_two_namespaces_do_not_hear_each_other(bench, tmp_path):
    with NodeGroup(tmp_path / "a") as a, NodeGroup(tmp_path / "b") as b:
        for group, name in ((a, "a"), (b, "b")):
            group.start("physics_node", "-r", f"__ns:=/{name}", **SMALL["physics_node"])
            bench.status(f"{name}/physics_node", "waiting for a model", WARN)
        heard = [bench.hear(messages.CONTROL_NODES._replace(name=f"{name}/control_nodes")) for name in "ab"]
        in_a = lambda topic: topic._replace(name=f"a/{topic.name}")  # noqa: E731
        bench.publish(in_a(messages.TRAINING_CAMERAS), messages.encode_poses([np.eye(4)], 5 * S, "world"))
        bench.publish(in_a(messages.GAUSSIANS), messages.encode_gaussians(sheet(), 5 * S, "world"))
        bench.until(lambda: heard[0], "control nodes of the first graph")
        said = len(bench.statuses["b/physics_node"])
        bench.status("b/physics_node", "waiting for a model", WARN, since=said)
        assert not heard[1]


def test_whole_graph_starts_in_the_wrong_order_and_survives_the_loss_of_each_node(bench, graph, small_bag, tmp_path):
    options = {name: dict(values) for name, values in SMALL.items()}
    options["reconstruction_node"] |= {"start_after": 0.5, "output_dir": tmp_path / "models"}
    start = lambda name, **more: graph.start(name, **options[name], **more)  # noqa: E731

    def kill(name):
        graph.nodes[name].send_signal(signal.SIGKILL)
        assert graph.nodes[name].wait(5) == -signal.SIGKILL
        bench.statuses[name].clear()

    def replay():
        player = graph.start("bag_player_node", bag=small_bag)
        bench.until(lambda: player.exit_status is not None, "the bag to be played", 40)
        assert player.exit_status == 0, log_of(player)

    def followed():
        bench.until(
            lambda: (
                bench.statuses["rendering_node"][-1:] and bench.statuses["rendering_node"][-1][2].get("following control nodes") == "True"
            ),
            lambda: f"the renderer to follow control nodes; it said {bench.statuses['rendering_node'][-1:]}",
            40,
        )

    def pushed():
        """Push the middle of the tissue and see the picture change."""
        followed()
        skin = nodes_of(bench).rest[:60]
        tip = skin[np.linalg.norm(skin - skin.mean(0), axis=1).argmin()]
        bench.heard["rendered/image_raw"].clear()
        at_rest = await_image(bench, lambda image: image.max() > 50, "the tissue")
        pull(
            bench,
            lambda: moved(bench) > 3e-3 and np.abs(newest_image(bench) - at_rest).max() > 8,  # at rest exactly 0
            (1.5, 0, -3.0),
            tip,
            lambda: f"pixels to change; {moved(bench)} m, {bench.statuses['physics_node'][-1:]}",
        )
        far = moved(bench)  # so few nodes creep back the last millimetre for minutes after a long pull
        bench.until(lambda: moved(bench) < 0.5 * far, lambda: f"the tissue to be released; {moved(bench)} of {far} m", 60)
        bench.until(lambda: bench.call(Trigger, "/physics_node/reset").success, "a reset")
        bench.until(lambda: moved(bench) < 1e-4, "the tissue at rest")

    for topic in (messages.CONTROL_NODES, messages.RENDERED_IMAGE, messages.GAUSSIANS):
        bench.hear(topic)
    for name, waiting in (("rendering_node", "waiting for a model"), ("physics_node", "waiting for a model")):
        start(name)
        bench.status(name, waiting, WARN)
    start("reconstruction_node")
    bench.status("reconstruction_node", "collecting views", OK)
    replay()
    bench.status("reconstruction_node", "finished, model saved in", OK)
    pushed()
    first = nodes_of(bench).model_stamp_ns

    kill("physics_node")
    bench.heard["control_nodes"].clear()
    start("physics_node")
    await_nodes(bench, first)  # of the latched model
    pushed()

    kill("rendering_node")
    start("rendering_node")
    pushed()

    kill("reconstruction_node")
    start("reconstruction_node", model_file=next((tmp_path / "models").glob("*/model.ply")))
    bench.until(lambda: nodes_of(bench).model_stamp_ns > first, "control nodes of the model file", 30)
    pushed()
    second = nodes_of(bench).model_stamp_ns

    assert bench.set("reconstruction_node", iterations=100_000, publish_period=0.5)[0]
    replay()
    bench.until(lambda: nodes_of(bench).model_stamp_ns > second, "control nodes of the new replay", 30)
    bench.status("reconstruction_node", "training, iteration", OK)

    begun = time.monotonic()  # in the middle of it all
    graph.stop()
    assert time.monotonic() - begun < 8
    for name, node in graph.nodes.items():
        assert node.exit_status == 0, name
        assert "Traceback" not in log_of(node), log_of(node)
