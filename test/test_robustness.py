"""What a graph must bear: hostile files, disturbed recordings, two machines, neighbours, random traffic."""

import array
import io
import json
import os
import pickle
import shutil
import struct
import subprocess
import sys
import time
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest
import rclpy
import torch
from conftest import wait_until
from test_nodes import Bench, S, send_model
from trained import trainer_of

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import load_cameras
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import ModelError, load_ply, ply_fields
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.graph.soak import soak
from endo_sim_ros.messages import OK
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNode
from endo_sim_ros.reconstruction import ReconstructionConfig
from endo_sim_ros.sequences.bag import BagReader
from endo_sim_ros.sequences.recordings import read_calibration

# --------------------------------------------------------------------------------------------------------- files

COUNT = 10
NUMBERS = np.linspace(-1, 1, COUNT * len(ply_fields(0))).reshape(COUNT, -1)


def ply(order="binary_little_endian", count=COUNT, extra=(), before=""):
    lines = ["ply", f"format {order} 1.0", *([before] if before else []), f"element vertex {count}"]
    lines += [*(f"property float {name}" for name in [*ply_fields(0), *extra]), "end_header", ""]
    return "\n".join(lines).encode()


LITTLE = NUMBERS.astype("<f4").tobytes()
TEXT = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in NUMBERS).encode()


@pytest.mark.parametrize(
    "data",
    [
        ply() + LITTLE,
        ply().replace(b"\n", b"\r\n") + LITTLE,
        ply("binary_big_endian") + NUMBERS.astype(">f4").tobytes(),
        ply("ascii") + TEXT,
        ply().replace(b"end_header", b"element face 9\nproperty list uchar int corners\nend_header") + LITTLE,
    ],
)
def test_every_kind_of_ply_gives_the_same_model(tmp_path, data):
    (tmp_path / "model.ply").write_bytes(data)
    np.testing.assert_allclose(load_ply(tmp_path / "model.ply").means, NUMBERS[:, :3], rtol=1e-6)


HOSTILE_PLYS = {
    "a_trillion_vertices": (ply(count=10**12) + LITTLE, "claims 1000000000000 vertices"),
    "a_trillion_lines": (ply("ascii", count=10**12) + TEXT, "claims 1000000000000 vertices"),
    "more_than_any_integer": (ply(count=10**40) + LITTLE, "claims 1"),
    "less_than_none": (ply(count=-1) + LITTLE, "claims -1 vertices"),
    "truncated": (ply() + LITTLE[:-1], "claims 10 vertices of 56 bytes or more, 559 bytes follow"),
    "truncated_text": (ply("ascii") + TEXT[:-8], "not a readable PLY"),
    "a_hundred_thousand_properties": (ply(extra=[f"p{i}" for i in range(100_000)]) + LITTLE, "no PLY header within"),
    "a_comment_without_end": (b"ply\ncomment " + b"x" * 10**7, "no PLY header within"),
    "lists": (ply().replace(b"float x", b"list uint float x") + LITTLE, "'property list uint float x'"),
    "a_trillion_faces_first": (ply(before="element face 1000000000000\nproperty list uint int i") + LITTLE, "'property list"),
    "unknown_type": (ply().replace(b"float x", b"object x") + LITTLE, "'property object x'"),
    "equal_names": (ply(extra=["x"]) + LITTLE * 2, "not a readable PLY"),
}


@pytest.mark.parametrize("name", HOSTILE_PLYS)
def test_a_ply_that_lies_is_refused_at_once_without_the_memory_it_claims(tmp_path, name):
    data, sentence = HOSTILE_PLYS[name]
    (tmp_path / "model.ply").write_bytes(data)
    tracemalloc.start()
    began = time.monotonic()
    with pytest.raises(ModelError, match=f"model.ply: .*{sentence}") as caught:
        load_ply(tmp_path / "model.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.monotonic() - began < 1 and peak < 1_000_000 and len(str(caught.value)) < 500


class Payload:
    """Unpickled, it leaves a file behind."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return open, (str(self.trace), "w")


@pytest.fixture(scope="module")
def trainer(small_frames):
    """A training that has begun."""
    config = ReconstructionConfig(iterations=20, max_gaussians=500, image_width=48, device="cpu")
    trainer = trainer_of(list(small_frames[:1]), config)
    trainer.step()
    return trainer


def bomb(data):
    """A checkpoint whose tensors are a hundred megabytes of zeros, in a tenth of a megabyte."""
    source, packed = zipfile.ZipFile(io.BytesIO(data)), io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry in source.infolist():
            archive.writestr(entry.filename, bytes(10**8) if entry.filename.endswith("/data/0") else source.read(entry))
    return packed.getvalue()


def repacked(**changes):
    """Changes to the contents of a checkpoint."""

    def change(data, trace):
        state = torch.load(io.BytesIO(data))
        buffer = io.BytesIO()
        torch.save(state | {name: make(state[name], trace) for name, make in changes.items()}, buffer)
        return buffer.getvalue()

    return change


def huge(model, _):
    """Views of one number that claim to be a trillion Gaussians."""
    return {name: torch.zeros(1).expand(10**12, *tensor.shape[1:]) for name, tensor in model.items()}


def short_moments(optimizer, _):
    return optimizer | {"means": {name: value[:1] if value.ndim else value for name, value in optimizer["means"].items()}}


HOSTILE_CHECKPOINTS = {
    "payload": (repacked(order=lambda _, trace: Payload(trace)), "other objects than tensors and numbers"),
    "bare_pickle": (lambda _, trace: pickle.dumps(Payload(trace)), "not a zip file"),
    "truncated": (lambda data, _: data[:-100], "not a zip file"),
    "damaged": (lambda data, _: data[: len(data) // 2] + bytes(64) + data[len(data) // 2 + 64 :], "it is damaged"),
    "zip_bomb": (lambda data, _: bomb(data), "claims more than it holds"),
    "a_trillion_gaussians": (repacked(model=huge), "claims more than it holds"),
    "wrong_keys": (repacked(model=lambda model, _: {"means": model["means"]}), "missing 4 required"),
    "wrong_shapes": (repacked(model=lambda model, _: model | {"quats": model["means"]}), r"quats has shape \(\d+, 3\)"),
    "not_finite": (repacked(model=lambda model, _: model | {"means": model["means"] * np.nan}), "finite float32"),
    "other_optimiser": (repacked(optimizer=short_moments), "does not fit the model"),
    "other_views": (repacked(order=lambda *_: [7]), "names views"),
    "a_number": (repacked(config=lambda *_: 3), "not a readable checkpoint"),
}


@pytest.mark.parametrize("name", HOSTILE_CHECKPOINTS)
def test_a_hostile_checkpoint_is_one_sentence_runs_no_code_and_leaves_the_training_alone(trainer, tmp_path, name):
    change, sentence = HOSTILE_CHECKPOINTS[name]
    path, trace = tmp_path / "checkpoint.pt", tmp_path / "trace"
    trainer.save_checkpoint(path)
    path.write_bytes(change(path.read_bytes(), trace))
    before = trainer.model.means
    with pytest.raises(SequenceError, match=f"checkpoint.pt: .*{sentence}") as caught:
        trainer.load_checkpoint(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
    assert not trace.exists() and torch.equal(trainer.model.means, before)
    trainer.step()
    assert trainer.model.means.isfinite().all()


CAMERA = {"K": [[90, 0, 48], [0, 90, 40], [0, 0, 1]], "width": 96, "height": 80, "pose": np.eye(4).tolist()}
HOSTILE_CAMERAS = {
    "no_list": ("{}", "expected a list"),
    "missing_key": (json.dumps([{"K": CAMERA["K"]}]), "'width'"),
    "not_finite": (json.dumps([CAMERA | {"K": [[float("nan")] * 3] * 3}]), "must be a finite 3×3"),
    "infinite_width": (json.dumps([CAMERA]).replace("96", "1e999"), "cannot convert float infinity"),
    "huge_width": (json.dumps([CAMERA | {"width": 10**12}]), "no camera has 1000000000000×80 pixels"),
    "no_rotation": (json.dumps([CAMERA | {"pose": np.zeros((4, 4)).tolist()}]), "no camera has"),
    "ragged": (json.dumps([CAMERA | {"pose": [[1], [2, 3]]}]), "not a readable list of cameras"),
    "a_hundred_thousand_brackets": ("[" * 100_000, "not a readable list of cameras"),
    "a_hundred_thousand_digits": (json.dumps([CAMERA]).replace("96", "9" * 100_000), "not a readable list of cameras"),
    "a_long_matrix": (json.dumps([CAMERA | {"K": [0.0] * 100_000}]), "must be a finite 3×3"),
    "too_long": (" " * 65_000_000, "far more than cameras need"),
}


@pytest.mark.parametrize("name", HOSTILE_CAMERAS)
def test_hostile_cameras_are_one_sentence(tmp_path, name):
    text, sentence = HOSTILE_CAMERAS[name]
    (tmp_path / "cameras.json").write_text(text)
    with pytest.raises(ValueError, match=f"cameras.json: .*{sentence}") as caught:
        load_cameras(tmp_path / "cameras.json")
    assert len(str(caught.value)) < 500


def test_a_calibration_file_runs_no_code(tmp_path):
    path, trace = tmp_path / "calibration.yaml", tmp_path / "trace"
    path.write_text(f"fx: !!python/object/apply:builtins.open ['{trace}', 'w']\n")
    with pytest.raises(SequenceError, match="calibration.yaml: not a readable YAML file"):
        read_calibration(path)
    assert not trace.exists()


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("fx: true\n", "fx must be a positive number, got True"),
        ("fx: " + "1" * 400, "fx must be a positive number"),
        ("fx: " + "1" * 6000, "not a readable YAML file|must be a positive number"),
        ("fx: " + "[" * 3000, "not a readable YAML file"),
        ("fx: 500\nfy: 500\ncx: 1\ncy: 1\ndistortion: [.nan]\n", "distortion must be finite"),
        ("a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]\n" for i in range(1, 20)) + "fx: *a19\n", "fx must be"),
        ("# " + "x" * 100_000, "far more than a calibration needs"),
    ],
)
def test_a_calibration_file_beyond_all_bounds_is_one_short_sentence(tmp_path, text, sentence):
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    with pytest.raises(SequenceError, match=sentence) as error:
        read_calibration(path)
    assert len(str(error.value)) < 1000


def test_a_png_that_claims_gigabytes_is_no_image():
    size = 20_000
    row = zlib.compress(bytes(size * (size // 8 + 1)), 9)  # one bit a pixel
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))  # noqa: E731
    header = struct.pack(">IIBBBBB", size, size, 1, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", row) + chunk(b"IEND", b"")
    message = messages.ros_class(messages.LEFT_COMPRESSED.type)(format="png", data=array.array("B", png))
    with pytest.raises(messages.MessageError, match="not a readable jpeg or png image of at most 64 megapixels"):
        messages.decode_image(message)


# --------------------------------------------------------------------------------------------------- disturbances


@pytest.fixture
def bench(tmp_path):
    """A reconstruction in this process that is quick to take a pause for the end, and a user."""
    values = {"iterations": 5, "max_gaussians": 300, "image_width": 48, "keyframes": 3, "start_after": 0.4, "image_timeout": 1.0}
    values["output_dir"] = tmp_path
    arguments = [word for name, value in values.items() for word in ("-p", f"reconstruction_node:{name}:={value}")]
    rclpy.init(args=["--ros-args", *arguments])
    bench = Bench()
    yield bench
    bench.close()
    rclpy.try_shutdown()


class Recording:
    """Sends the images and poses of a recording in any order."""

    def __init__(self, bench, frames):
        self._bench, self._frames = bench, frames
        camera = frames[0].camera
        info = messages.encode_camera_info(camera.K, camera.width, camera.height, S, "endoscope_left")
        bench.publish(messages.LEFT_INFO, info)

    def image(self, number, shift=0):
        frame = self._frames[number]
        self._bench.publish(messages.LEFT_IMAGE, messages.encode_image(frame.image, frame.stamp_ns + shift, "endoscope_left"))
        self._bench.spin(0.03)

    def pose(self, number, shift=0):
        frame = self._frames[number]
        self._bench.publish(messages.CAMERA_POSE, messages.encode_pose(frame.camera.pose, frame.stamp_ns + shift, "world"))
        self._bench.spin(0.01)


def finished(bench, node, views):
    """Wait for the reconstruction of all of so many views; what diagnostics say."""

    def said():
        for level, text, values in bench.statuses["reconstruction_node"][-1:]:
            return level == OK and "finished" in text and values["views"] == str(views) and values

    values = bench.until(said, lambda: f"{views} views: {bench.statuses['reconstruction_node'][-2:]}", 30)
    assert node._trained == (node._frames[0].stamp_ns, node._frames[-1].stamp_ns)
    return values


@pytest.mark.parametrize("lag", [-3, 3])
def test_repeated_swapped_and_unposed_images_are_counted_and_the_others_reconstructed(bench, small_frames, lag):
    """Poses come three images before or after theirs, two never; two images change places, some come twice."""
    node = bench.add(ReconstructionNode)
    recording = Recording(bench, small_frames)
    order = [0, 1, 2, 4, 3, 5, 6, 7, 8, 9, 10, 11]
    for step in range(-3, len(order) + 3):
        if 0 <= step < len(order):
            recording.image(order[step])
            if step % 4 == 1:
                recording.image(order[step])
        if 0 <= step - lag < len(order) and step - lag not in (6, 9):
            recording.pose(step - lag)
    recording.image(0)  # once more, long after it was used
    values = finished(bench, node, views=10)
    assert (values["images without pose"], values["images out of order"], values["images invalid"]) == ("2", "1", "0")
    assert [frame.stamp_ns for frame in node._frames] == [small_frames[k].stamp_ns for k in range(12) if k not in (6, 9)]
    for frame, k in zip(node._frames, (k for k in range(12) if k not in (6, 9)), strict=True):
        np.testing.assert_allclose(frame.camera.pose, small_frames[k].camera.pose, atol=1e-6)


def test_a_recording_with_a_gap_ends_with_the_views_of_both_its_parts(bench, small_frames):
    """The pause is longer than the silence that means the end: a first model comes early, the last is of everything."""
    node = bench.add(ReconstructionNode)
    recording = Recording(bench, small_frames)
    for number in range(12):
        shift = 3 * S * (number > 5)
        if number not in (2, 8):
            recording.pose(number, shift)
        recording.image(number, shift)
        if number == 5:
            bench.until(lambda: node._trained, "the first part to be reconstructed")
            bench.spin(1.0)
    values = finished(bench, node, views=10)
    assert values["images without pose"] == "2" and values["images out of order"] == "0"


# ----------------------------------------------------------------------------------------------------- neighbours


def test_two_graphs_in_two_domains_do_not_hear_each_other(bench, tmp_path):
    mine = int(os.environ["ROS_DOMAIN_ID"])
    heard = bench.hear(messages.CONTROL_NODES)
    with NodeGroup(tmp_path / "mine") as near, NodeGroup(tmp_path / "other") as far:
        far.environment["ROS_DOMAIN_ID"] = str(1 + (mine + 50) % 100)
        near.start("physics_node", node_count=300)
        far.start("rendering_node")
        far.start("recorder_node", bag=tmp_path / "bag")
        bench.status("physics_node", "waiting for a model")
        wait_until((tmp_path / "bag").exists, 30, "the recorder")
        send_model(bench)
        bench.until(lambda: len(heard) > 50, "control nodes")
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) == {messages.DIAGNOSTICS.name}
        nodes = {name for *_, message in bag.messages([messages.DIAGNOSTICS]) for name, *_ in messages.decode_diagnostics(message)}
    assert nodes <= {"recorder", "rendering_node"} and set(bench.statuses) == {"physics_node", "user"}


LISTENER = """
import rclpy
from endo_sim_ros import messages
from endo_sim_ros.nodes.base import quality
from endo_sim_ros.nodes.transport import prepare_transport

prepare_transport()
rclpy.init()
node = rclpy.create_node("listener")
heard = set()


def tell(what):
    if what not in heard:
        heard.add(what)
        print(what, flush=True)


for topic in (messages.GAUSSIANS, messages.CONTROL_NODES, messages.RENDERED_IMAGE):
    node.create_subscription(messages.ros_class(topic.type), topic.name, lambda _, name=topic.name: tell(name), quality(topic))
kind, topic = messages.ros_class(messages.DIAGNOSTICS.type), messages.DIAGNOSTICS
node.create_subscription(kind, topic.name, lambda m: [tell(s.name) for s in m.status], quality(topic))
rclpy.spin(node)
"""


@pytest.fixture
def two_hosts():
    """Names of two network namespaces that only see each other, as two machines at one cable do."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and the command ip")
    names = [f"endo_sim_{os.getpid()}_{side}" for side in "ab"]

    def ip(*arguments):
        return subprocess.run(["ip", *arguments], capture_output=True, text=True)

    try:
        for name in names:
            added = ip("netns", "add", name)
            if added.returncode:
                pytest.skip(f"network namespaces cannot be made here: {added.stderr.strip()}")
        first, second = names
        ip("link", "add", "cable", "netns", first, "type", "veth", "peer", "name", "cable", "netns", second).check_returncode()
        for number, name in enumerate(names, 1):
            for command in (
                f"addr add 10.66.0.{number}/24 dev cable", "link set cable up", "link set lo up", "route add 224.0.0.0/4 dev cable"
            ):  # fmt: skip
                ip("-n", name, *command.split()).check_returncode()
        yield names
    finally:
        for name in names:
            ip("netns", "del", name)


def test_a_graph_works_across_two_machines(two_hosts, small_bag, tmp_path):
    """Bag, reconstruction and a listener on one, physics and rendering on the other; no memory is shared."""
    first, second = two_hosts
    environment = os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    log, processes = tmp_path / "listener", []

    def start(host, *arguments, **parameters):
        command = ["ip", "netns", "exec", host, sys.executable, *arguments]
        if parameters:
            command += ["--ros-args", *(word for name, value in parameters.items() for word in ("-p", f"{name}:={value}"))]
        with log.with_name(f"{len(processes)}").open("w") as output:
            processes.append(subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT))
        return log.with_name(f"{len(processes) - 1}")

    def node(host, name, **parameters):
        return start(host, "-m", f"endo_sim_ros.nodes.{name}", **parameters)

    try:
        said = start(first, "-c", LISTENER)
        small = {"iterations": 10, "max_gaussians": 500, "image_width": 48, "start_after": 0.5, "output_dir": tmp_path}
        node(first, "reconstruction_node", **small)
        node(second, "physics_node", node_count=300)
        node(second, "rendering_node", rate=10.0)
        heard = lambda *what: set(what) <= set(said.read_text().splitlines())  # noqa: E731
        nodes = ("reconstruction_node", "physics_node", "rendering_node")
        wait_until(lambda: heard(*nodes), 60, lambda: f"all nodes; heard {said.read_text().split()}")
        node(first, "bag_player_node", bag=small_bag)
        topics = ("gaussians", "control_nodes", "rendered/image_raw")
        wait_until(lambda: heard(*topics), 60, lambda: f"{topics}; heard {said.read_text().split()}")
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


# -------------------------------------------------------------------------------------------------------- traffic


def test_the_graph_lives_and_works_after_ten_seconds_of_random_traffic(tmp_path):
    rows = {row.name: row.value for row in soak(tmp_path / "soak.json", minutes=10 / 60, seed=7)}
    assert rows["nodes that died"] == 0 and rows["messages sent"] > 1000 and rows["of them spoilt"] > 250, rows
    assert (tmp_path / "soak.json").exists()
