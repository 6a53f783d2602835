"""Every layout of msg_conventions.md, there and back, for a running graph and for bag files."""

import array
import copy
import dataclasses
import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import make_pose, quat_to_matrix
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.messages import ControlNodeCloud, MessageError, bag_types, ros_types


@pytest.mark.slow
def test_a_png_that_claims_gigabytes_is_no_image():
    size = 20_000
    row = zlib.compress(bytes(size * (size // 8 + 1)), 9)  # one bit a pixel
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))  # noqa: E731
    header = struct.pack(">IIBBBBB", size, size, 1, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", row) + chunk(b"IEND", b"")
    message = messages.ros_class(messages.LEFT_COMPRESSED.type)(format="png", data=array.array("B", png))
    with pytest.raises(messages.MessageError, match="not a readable jpeg or png image of at most 64 megapixels"):
        messages.decode_image(message)


STAMP = 12_345_678_901
K = np.array([[500.0, 0, 320], [0, 510, 256], [0, 0, 1]])
CONVENTIONS = (Path(__file__).parents[2] / "msg_conventions.md").read_text()


@pytest.fixture(params=["ros", "bag"])
def wire(request):
    """Message classes, and a function that sends a message over the wire and back."""
    types = ros_types() if request.param == "ros" else bag_types()

    def transport(message, full_name):
        if request.param == "ros":
            from rclpy.serialization import deserialize_message, serialize_message

            return deserialize_message(serialize_message(message), messages.ros_class(full_name))
        store = bag_types().typestore
        return store.deserialize_cdr(store.serialize_cdr(message, full_name), full_name)

    return types, transport


def model(n=50, degree=2, seed=0):
    g = torch.Generator().manual_seed(seed)
    r = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return GaussianModel(r(n, 3), r(n, 4), r(n, 3), r(n), r(n, (degree + 1) ** 2, 3))


def image(height=5, width=7):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


@pytest.mark.slow
def test_bag_bytes_are_what_ros_reads():
    from rclpy.serialization import deserialize_message

    for make, name in (
        (lambda t: messages.encode_image(image(), STAMP, "cam", t), "sensor_msgs/msg/Image"),
        (lambda t: messages.encode_compressed(image(), STAMP, "cam", 90, t), "sensor_msgs/msg/CompressedImage"),
        (lambda t: messages.encode_text("LARGE_NEEDLE_DRIVER:400006", t), "std_msgs/msg/String"),
        (lambda t: messages.encode_gaussians(model(), STAMP, "world", t), "sensor_msgs/msg/PointCloud2"),
        (lambda t: messages.encode_camera_info(K, 640, 512, STAMP, "cam", 0.005, t), "sensor_msgs/msg/CameraInfo"),
        (lambda t: messages.encode_pose(np.eye(4), STAMP, "world", t), "geometry_msgs/msg/PoseStamped"),
        (lambda t: messages.encode_diagnostics("a", 2, "b", {"c": 1}, STAMP, t), "diagnostic_msgs/msg/DiagnosticArray"),
    ):
        written = bytes(bag_types().typestore.serialize_cdr(make(bag_types()), name))
        assert deserialize_message(written, messages.ros_class(name)) == make(ros_types()), name


def test_image_round_trip(wire):
    types, transport = wire
    for pixels, decode in (
        (image(), messages.decode_image),
        (np.where(image()[..., 0] > 127, 255, 0).astype(np.uint8), messages.decode_mask),
        (image()[..., 0].astype(np.float32) / 1000 + 0.001, messages.decode_depth),
    ):
        message = transport(messages.encode_image(pixels, STAMP, "cam", types), "sensor_msgs/msg/Image")
        np.testing.assert_array_equal(decode(message), pixels)
        assert messages.stamp_to_ns(message.header.stamp) == STAMP
        assert message.header.frame_id == "cam"


@pytest.mark.parametrize("encoding, channels", [("rgb8", 3), ("bgr8", 3), ("mono8", 1), ("rgba8", 4), ("bgra8", 4)])
@pytest.mark.parametrize("padding", [0, 5])
def test_every_color_encoding_becomes_rgb(encoding, channels, padding):
    rgb = image()
    if channels == 1:
        rgb = np.repeat(rgb[..., :1], 3, 2)
    pixels = {"b": rgb[..., ::-1], "r": rgb, "m": rgb[..., :1]}[encoding[0]]
    if channels == 4:
        pixels = np.concatenate([pixels, np.full((5, 7, 1), 9, np.uint8)], 2)
    rows = np.pad(pixels.reshape(5, -1), ((0, 0), (0, padding)))
    message = messages.encode_image(rgb, STAMP, "cam")
    message.encoding, message.step, message.data = encoding, rows.shape[1], ros_types().sequence(rows.reshape(-1))
    np.testing.assert_array_equal(messages.decode_image(message), rgb)


def test_an_image_survives_its_compression(wire):
    types, transport = wire
    smooth = np.repeat(np.linspace(0, 250, 64).astype(np.uint8)[None, :, None], 48, 0) * np.array([1, 0, 0], np.uint8)
    message = transport(messages.encode_compressed(smooth, STAMP, "cam", 95, types), "sensor_msgs/msg/CompressedImage")
    assert "jpeg" in message.format and message.header.frame_id == "cam"
    assert np.abs(messages.decode_image(message).astype(int) - smooth).mean() < 3  # red is still red


def test_compressed_image_becomes_rgb():
    from sensor_msgs.msg import CompressedImage

    rgb = np.tile(np.array([[[200, 30, 60]]], np.uint8), (16, 16, 1))
    data = cv2.imencode(".png", rgb[..., ::-1])[1]
    np.testing.assert_array_equal(messages.decode_image(CompressedImage(format="png", data=data.tobytes())), rgb)
    with pytest.raises(MessageError, match="left/image_raw.*3 bytes.*jpeg"):
        messages.decode_image(CompressedImage(format="jpeg", data=b"abc"))


def test_depth_in_millimetres_and_without_measurement():
    millimetres = np.array([[0, 1500], [65535, 1]], np.uint16)
    message = messages.encode_image(np.zeros((2, 2), np.float32), STAMP, "cam")
    message.encoding, message.step, message.data = "16UC1", 4, ros_types().sequence(millimetres.view(np.uint8).reshape(-1))
    np.testing.assert_allclose(messages.decode_depth(message), millimetres * 1e-3, rtol=1e-6)
    message.is_bigendian, message.data = 1, ros_types().sequence(millimetres.byteswap().view(np.uint8).reshape(-1))
    np.testing.assert_allclose(messages.decode_depth(message), millimetres * 1e-3, rtol=1e-6)
    holes = np.array([[np.nan, -1], [np.inf, 0.1]], np.float32)
    decoded = messages.decode_depth(messages.encode_image(holes, STAMP, "cam"))
    np.testing.assert_array_equal(decoded, np.array([[0, 0], [0, 0.1]], np.float32))


def test_camera_info_round_trip(wire):
    types, transport = wire
    message = transport(messages.encode_camera_info(K, 640, 512, STAMP, "cam", 0.0054, types), "sensor_msgs/msg/CameraInfo")
    info = messages.decode_camera_info(message)
    np.testing.assert_array_equal(info.K, K)
    assert (info.width, info.height, info.rectified) == (640, 512, True)
    assert info.baseline == pytest.approx(0.0054)
    assert message.p[3] == pytest.approx(-500 * 0.0054)


def test_raw_images_are_rectified_by_their_camera_info():
    from sensor_msgs.msg import CameraInfo

    D, R = np.array([-0.3, 0.1, 0, 0, 0]), quat_to_matrix([1, 0.01, 0.02, 0])
    message = CameraInfo(width=640, height=512, k=K.ravel(), d=D.tolist(), r=R.ravel(), p=np.hstack([K, np.zeros((3, 1))]).ravel())
    info = messages.decode_camera_info(message)
    assert not info.rectified
    dot = np.zeros((512, 640), np.float32)
    dot[100:103, 500:503] = 1
    moved = np.array(cv2.minMaxLoc(cv2.GaussianBlur(info.rectify(dot), (7, 7), 0))[3], float)
    expected = cv2.undistortPoints(np.array([[[501.0, 101.0]]]), K, D, R=R, P=K)[0, 0]
    assert np.linalg.norm(moved - expected) < 1.5
    message.d = [0.3, 0.0, 0.0, 0.0, 0.0]
    info = messages.decode_camera_info(message)
    lit = info.rectify(np.full((512, 640), 200, np.uint8), nearest=True)
    np.testing.assert_array_equal(info.valid > 0, lit > 0)  # the border beyond the raw image is known
    assert not info.valid.all() and info.valid.mean() > 128
    assert np.linalg.norm(expected - [501, 101]) > 5


def test_pose_round_trip(wire):
    types, transport = wire
    pose = make_pose([1, -2, 3], [0.5, -0.5, 0.1, 0.7])
    message = transport(messages.encode_pose(pose, STAMP, "world", types), "geometry_msgs/msg/PoseStamped")
    np.testing.assert_allclose(messages.decode_pose(message, "world", "t"), pose, atol=1e-12)
    message = transport(messages.encode_poses([pose, np.eye(4)], STAMP, "world", types), "geometry_msgs/msg/PoseArray")
    np.testing.assert_allclose(messages.decode_poses(message), [pose, np.eye(4)], atol=1e-12)


def test_wrench_and_jaw_round_trip(wire):
    types, transport = wire
    message = transport(messages.encode_wrench([1, 2, 3], [4, 5, 6], STAMP, "PSM1", types), "geometry_msgs/msg/WrenchStamped")
    np.testing.assert_array_equal(messages.decode_wrench(message, "t"), [[1, 2, 3], [4, 5, 6]])
    message = transport(messages.encode_jaw(0.4, STAMP, types), "sensor_msgs/msg/JointState")
    assert messages.decode_jaw(message, "t") == 0.4


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gaussians_round_trip(wire, degree):
    types, transport = wire
    sent = model(degree=degree)
    sent = dataclasses.replace(sent, bared=sent.sh[:, 0] / 3)
    message = transport(messages.encode_gaussians(sent, STAMP, "world", types), "sensor_msgs/msg/PointCloud2")
    received = messages.decode_gaussians(message)
    for name, value in sent.tensors().items():
        assert torch.equal(value, received.tensors()[name]), name
    color = messages.decode_cloud(message, "gaussians")["rgb"].view(np.uint32)
    expected = (sent.base_colors.numpy() * 255 + 0.5).astype(np.uint32)
    np.testing.assert_array_equal(np.stack([color >> 16 & 255, color >> 8 & 255, color & 255], 1), expected)


def test_control_nodes_round_trip(wire):
    types, transport = wire
    rng = np.random.default_rng(0)
    sent = ControlNodeCloud(*(rng.random(s, np.float32) for s in ((9, 3), (9, 3), (9, 3, 3))), model_stamp_ns=STAMP)
    message = transport(messages.encode_control_nodes(sent, STAMP + 5, "world", types), "sensor_msgs/msg/PointCloud2")
    received = messages.decode_control_nodes(message)
    for name in ("rest", "positions", "F"):
        np.testing.assert_array_equal(getattr(received, name), getattr(sent, name))
    assert received.model_stamp_ns == STAMP


def test_clouds_are_decoded_by_field_name_whatever_their_layout():
    """Another encoder's order, gaps, types and byte order."""
    sent = model(degree=0)
    message = messages.encode_gaussians(sent, STAMP, "world")
    points = messages.decode_cloud(message, "gaussians")
    names = [name for name in points.dtype.names if name != "rgb"][::-1]
    layout = np.dtype({
        "names": names, "formats": [">f8" if i % 2 else ">f4" for i in range(len(names))],
        "offsets": [3 + 9 * i for i in range(len(names))], "itemsize": 9 * len(names) + 11,
    })  # fmt: skip
    other = np.zeros(len(points), layout)
    for name in names:
        other[name] = points[name]
    from sensor_msgs.msg import PointField

    message.fields = [
        PointField(name=name, offset=layout.fields[name][1], datatype=8 if layout[name].itemsize == 8 else 7, count=1) for name in names
    ]
    message.is_bigendian, message.point_step, message.row_step = True, layout.itemsize, other.nbytes
    message.data = ros_types().sequence(other.view(np.uint8))
    received = messages.decode_gaussians(message)
    for name, value in sent.tensors().items():
        assert torch.equal(value, received.tensors()[name]), name


def test_diagnostics_round_trip(wire):
    types, transport = wire
    message = messages.encode_diagnostics("node", messages.WARN, "careful", {"a": 1.5}, STAMP, types)
    message = transport(message, "diagnostic_msgs/msg/DiagnosticArray")
    assert messages.decode_diagnostics(message) == [("node", messages.WARN, "careful", {"a": "1.5"})]


def test_large_messages_cross_as_whole_blocks_of_memory():
    """Never element by element, which would take a thousand times as long."""
    pixels = np.zeros((512, 640, 3), np.uint8)
    message = messages.encode_image(pixels, 1, "cam")
    assert type(message.data) is array.array and message.data.typecode == "B"  # what ROS takes as it is
    assert np.shares_memory(messages.decode_image(message), np.frombuffer(message.data, np.uint8))


BAD = {
    "unknown encoding": (lambda m: setattr(m, "encoding", "yuv422"), "encoding 'yuv422'.*rgb8"),
    "too few bytes": (lambda m: setattr(m, "data", m.data[:-1]), "do not hold a 7×5 rgb8 image"),
    "wrong step": (lambda m: setattr(m, "step", 3), "do not hold a 7×5"),
    "no pixels": (lambda m: setattr(m, "width", 0), "empty"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_image_is_one_sentence_that_names_the_topic(name):
    message = messages.encode_image(image(), STAMP, "cam")
    BAD[name][0](message)
    with pytest.raises(MessageError, match=f"endoscope/left/image_raw.*{BAD[name][1]}"):
        messages.decode_image(message)
    message.encoding = "rgb8"
    with pytest.raises(MessageError, match="depth: encoding 'rgb8'.*32FC1"):
        messages.decode_depth(message)
    with pytest.raises(MessageError, match="mask: encoding 'rgb8'.*mono8"):
        messages.decode_mask(message)


def test_bad_camera_info_is_refused():
    message = messages.encode_camera_info(K, 640, 512, STAMP, "cam")
    message.k = np.zeros(9)
    with pytest.raises(MessageError, match="camera_info: K has focal lengths 0.*not calibrated"):
        messages.decode_camera_info(message)
    message = messages.encode_camera_info(K * np.nan, 640, 512, STAMP, "cam")
    with pytest.raises(MessageError, match="camera_info: K is not finite"):
        messages.decode_camera_info(message)
    for field, value, sentence in (
        ("d", [0.1, 0.2, 0.3], "not a set of OpenCV distortion coefficients"),
        ("d", [1e300, 0, 0, 0, 0], "not a set of OpenCV distortion coefficients"),
        ("r", np.ones(9), "R is not a rotation"),
        ("p", np.array([500.0, 0, 320, 0, 0, 500, 256, 0, 0, 0, 0, 0]), "last row of P"),
        ("k", np.array([1e9, 0, 320, 0, 500, 256, 0, 0, 1]), r"K has focal lengths 1e\+09 and 500 pixels, which no endoscope has"),
        ("k", np.array([500.0, 0, 960, 0, 500, 256, 0, 0, 1]), r"K has the principal point \(960, 256\), outside the images of 640×512"),
        ("p", np.array([500.0, 0, 320, 0, 0, 500, -9, 0, 0, 0, 1, 0]), r"P has the principal point \(320, -9\), outside"),
    ):
        message = messages.encode_camera_info(K, 640, 512, STAMP, "cam")
        setattr(message, field, value)
        with pytest.raises(MessageError, match=f"camera_info: .*{sentence}"):
            messages.decode_camera_info(message)
    message = messages.encode_camera_info(K, 640, 512, STAMP, "cam")
    message.d, message.distortion_model = [0.1, 0.0, 0.0, 0.0], "equidistant"
    with pytest.raises(MessageError, match="distortion_model 'equidistant' is not supported"):
        messages.decode_camera_info(message)


def test_bad_pose_is_refused():
    message = messages.encode_pose(np.eye(4), STAMP, "world")
    message.pose.position.x = float("nan")
    with pytest.raises(MessageError, match="ECM/measured_cp: the pose is not finite"):
        messages.decode_pose(message, "world", "ECM/measured_cp")
    message.pose.position.x, message.pose.orientation.w = 0.0, 2.0
    with pytest.raises(MessageError, match="length 2, not 1"):
        messages.decode_pose(message, "world", "ECM/measured_cp")
    with pytest.raises(MessageError, match="unknown frame 'world'.*'map'.*world_frame"):
        messages.decode_pose(messages.encode_pose(np.eye(4), STAMP, "world"), "map", "t")


def test_bad_wrench_and_jaw_are_refused():
    with pytest.raises(MessageError, match="servo_cf: the wrench is not finite"):
        messages.decode_wrench(messages.encode_wrench([0, np.nan, 0], [0, 0, 0], STAMP, ""), "PSM1/body/servo_cf")
    message = messages.encode_jaw(0.1, STAMP)
    message.position = [0.1, 0.2]
    with pytest.raises(MessageError, match="one finite jaw angle"):
        messages.decode_jaw(message, "PSM1/jaw/servo_jp")


def test_bad_clouds_are_refused():
    message = messages.encode_gaussians(model(), STAMP, "world")
    whole = message.data
    message.data = whole[:-4]
    with pytest.raises(MessageError, match="gaussians: the cloud is truncated"):
        messages.decode_gaussians(message)
    message.data, message.fields = whole, [f for f in message.fields if f.name != "opacity"]
    with pytest.raises(MessageError, match="gaussians: missing field opacity"):
        messages.decode_gaussians(message)
    with pytest.raises(MessageError, match="control_nodes: missing field rest_x"):
        messages.decode_control_nodes(message)
    with pytest.raises(MessageError, match="the model is empty"):
        messages.decode_gaussians(messages.encode_gaussians(model(0), STAMP, "world"))
    bad = model()
    bad.means[7, 1] = float("nan")
    with pytest.raises(MessageError, match="means of Gaussian 7 is not finite"):
        messages.decode_gaussians(messages.encode_gaussians(bad, STAMP, "world"))
    beyond = messages.encode_gaussians(model(), STAMP, "world")
    beyond.fields = copy.deepcopy(beyond.fields)  # messages share them
    beyond.fields[-1].offset = 10_000
    with pytest.raises(MessageError, match="beyond the point step"):
        messages.decode_gaussians(beyond)


def test_decoding_examples_of_the_conventions_run():
    """Each example is plain numpy and gives what the package gives."""
    examples = re.findall(r"```python\n(.+?)```", CONVENTIONS, re.S)
    assert len(examples) >= 3
    sent = model(degree=0)
    nodes = ControlNodeCloud(np.zeros((4, 3), "f4"), np.ones((4, 3), "f4"), np.tile(np.eye(3, dtype="f4"), (4, 1, 1)), STAMP)
    scope = {}
    for example in examples:
        exec(example, scope)
    found = scope["decode_gaussians"](messages.encode_gaussians(sent, STAMP, "world"))
    np.testing.assert_array_equal(found["means"], sent.means)
    np.testing.assert_allclose(found["scales"], sent.scales, rtol=1e-6)
    np.testing.assert_allclose(found["opacities"], sent.opacities, rtol=1e-5)
    rest, positions, F, stamp = scope["decode_control_nodes"](messages.encode_control_nodes(nodes, 1, "world"))
    np.testing.assert_array_equal(positions, nodes.positions)
    np.testing.assert_array_equal(rest, nodes.rest)
    np.testing.assert_array_equal(F, nodes.F)
    assert stamp == STAMP
    depth = np.random.default_rng(0).random((3, 4), np.float32)
    np.testing.assert_array_equal(scope["decode_depth"](messages.encode_image(depth, 1, "cam")), depth)


def test_cuts_keep_their_triangles_and_number(wire):
    types, transport = wire
    cloud = "sensor_msgs/msg/PointCloud2"
    triangles = np.random.default_rng(0).normal(size=(5, 3, 3)).astype(np.float32)
    for some in (triangles, triangles[:0]):
        torn = np.arange(len(some)) % 2 > 0
        received = transport(messages.encode_cut_surface(some, 7, "world", types, torn=torn), cloud)
        again = messages.decode_cut_surface(received)
        np.testing.assert_array_equal(again, some)
        np.testing.assert_array_equal(messages.decode_torn(received), torn)
        assert messages.cut_number(again) == messages.cut_number(some)
    assert messages.cut_number(triangles[:0]) == 0 != messages.cut_number(triangles)
    assert messages.cut_number(triangles) == messages.cut_number(triangles.astype(np.float64))
    for pressed in (False, True):
        assert messages.decode_pedal(transport(messages.encode_cut(pressed, 7, types), "sensor_msgs/msg/Joy"), "PSM1/cut") == pressed
    tapped = messages.encode_cut(True, 7, types)
    tapped.buttons[0] = 2
    assert not messages.decode_pedal(transport(tapped, "sensor_msgs/msg/Joy"), "PSM1/cut"), "a short tap is over"
    older = messages.encode_cut_surface(triangles, 7, "world", types)
    older.fields = older.fields[:3]  # as recordings from before tears were told have it
    np.testing.assert_array_equal(messages.decode_cut_surface(older), triangles)
    np.testing.assert_array_equal(messages.decode_torn(older), np.zeros(5, bool))
    triangles[0, 0, 0] = np.nan
    with pytest.raises(MessageError, match="cut_surface: a corner is not finite"):
        messages.decode_cut_surface(messages.encode_cut_surface(triangles, 7, "world", types))
    with pytest.raises(MessageError, match="three points .* for each triangle, got 4 points"):
        wrong = messages.encode_cut_surface(triangles[:2], 7, "world", types)
        wrong.width, wrong.row_step = 4, 64
        messages.decode_cut_surface(wrong)


def test_maps_of_stiffness_round_trip_and_what_is_no_map_is_refused(wire):
    types, transport = wire
    rng = np.random.default_rng(0)
    moduli = rng.uniform(1e3, 1e5, (3, 7)).astype(np.float32)
    cloud = messages.StiffnessCloud(rng.normal(size=(7, 3)).astype(np.float32), *moduli, rng.random(7) > 0.5)
    again = messages.decode_stiffness(transport(messages.encode_stiffness(cloud, 7, "world", types), "sensor_msgs/msg/PointCloud2"))
    for name in ("positions", "young_modulus", "low", "high", "known"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cloud, name))
    for text, values in (("not a finite number above zero", np.zeros(7)), ("not finite", np.full(7, np.nan))):
        bad = messages.StiffnessCloud(cloud.positions, values.astype(np.float32), *moduli[1:], cloud.known)
        with pytest.raises(MessageError, match=f"stiffness_map: .*{text}"):
            messages.decode_stiffness(messages.encode_stiffness(bad, 7, "world", types))
    with pytest.raises(MessageError, match="stiffness_map: missing field young_modulus, low, high, known"):
        messages.decode_stiffness(messages.encode_cut_surface(np.zeros((1, 3, 3)), 7, "world", types))


def test_poses_of_a_thing_keep_their_bits_and_what_is_none_is_refused(wire):
    types, transport = wire
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3] = np.random.default_rng(0).normal(size=(5, 3, 4))  # they may scale and shear
    message = transport(messages.encode_thing_poses(poses, 7, "world", types), "sensor_msgs/msg/PointCloud2")
    np.testing.assert_array_equal(messages.decode_thing_poses(message), poses)
    poses[3, 1, 2] = np.nan
    with pytest.raises(MessageError, match="thing_poses: a pose is not finite"):
        messages.decode_thing_poses(messages.encode_thing_poses(poses, 7, "world", types))
    with pytest.raises(MessageError, match="thing_poses: missing field f_00, f_01, f_02, f_10; see thing_poses in msg_conventions.md"):
        messages.decode_thing_poses(messages.encode_cut_surface(np.zeros((1, 3, 3)), 7, "world", types))
