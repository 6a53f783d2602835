"""The reader of SCARED, on small exact copies of its layout."""

import io
import json
import logging
import tarfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tifffile
from plane_scene import (
    BARREL,
    HEIGHT,
    K_LEFT,
    K_RIGHT,
    R_EYES,
    T_EYES,
    WIDTH,
    assert_frame_agrees,
    plane_colours,
    pose_of,
    right_pose,
    see_plane,
    stereo_images,
    write_rgb,
    write_video,
)
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences import scared as scared_reader
from endo_sim_ros.sequences.readers import open_sequence
from endo_sim_ros.sequences.scared import read_scared
from endo_sim_ros.sequences.scared_archives import published_pose, read_frame_data
from endo_sim_ros.sequences.scared_pose_direction import find_pose_direction
from endo_sim_ros.sequences.stereo_images import StackedVideo


def add_member(tar, name: str, data: bytes):
    info = tarfile.TarInfo(name)
    info.size = len(data)
    tar.addfile(info, io.BytesIO(data))


def tiff_bytes(points: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, points.astype(np.float32), photometric="rgb")
    return buffer.getvalue()


def write_scared(root: Path, *, world_to_camera=True, order=None, yaml=True, count=6):
    poses = {n: pose_of((0.0025 * n, -0.0015 * n, 0.0), z=0.02 * n) for n in range(count)}
    left, points = see_plane(K_LEFT, BARREL, poses[0])
    right, _ = see_plane(K_RIGHT, BARREL, right_pose(poses[0], R_EYES, T_EYES))
    write_rgb(root / "Left_Image.png", left)
    write_rgb(root / "Right_Image.png", right)
    points = 1000 * points
    points[:10] = np.nan
    tifffile.imwrite(root / "left_depth_map.tiff", points.astype(np.float32), photometric="rgb")
    if yaml:
        storage = cv2.FileStorage(str(root / "endoscope_calibration.yaml"), cv2.FILE_STORAGE_WRITE)
        for name, value in (("M1", K_LEFT), ("D1", BARREL[None]), ("M2", K_RIGHT), ("D2", BARREL[None])):
            storage.write(name, value)
        storage.write("R", R_EYES)
        storage.write("T", 1000 * T_EYES[:, None])
        storage.release()
    write_video(root / "data/rgb.mp4", (np.vstack(pair) for pair in stereo_images(poses)))
    calibration = {"KL": K_LEFT.tolist(), "KR": K_RIGHT.tolist(), "DL": [BARREL.tolist()], "DR": [BARREL.tolist()]}
    calibration |= {"R": R_EYES.tolist(), "T": (1000 * T_EYES[:, None]).tolist()}
    with tarfile.open(root / "data/frame_data.tar.gz", "w:gz", compresslevel=1) as tar:
        for number, pose in poses.items():
            matrix = np.linalg.inv(pose) if world_to_camera else pose.copy()
            matrix[:3, 3] *= 1000
            document = {"camera-pose": matrix.tolist(), "camera-calibration": calibration, "timestamp": 0}
            add_member(tar, f"frame_data{number:06d}.json", json.dumps(document).encode())
    with tarfile.open(root / "data/scene_points.tar.gz", "w:gz", compresslevel=1) as tar:
        for number in order or range(count):
            _, points = see_plane(K_LEFT, BARREL, poses[number])
            add_member(tar, f"./scene_points{number:06d}.tiff", tiff_bytes(1000 * np.vstack([points, points])))
    return root


def extract(root: Path, *names: str):
    """Replace archives by the folders that they unpack to."""
    for name in names:
        archive = root / f"data/{name}.tar.gz"
        with tarfile.open(archive) as tar:
            tar.extractall(root / "data" / name, filter="data")
        archive.unlink()


def preprocess(root: Path, *, disparity=False):
    """Replace the video by what is commonly prepared of it: images rectified with OpenCV's defaults, and their disparity."""
    size = (WIDTH, HEIGHT)
    R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(K_LEFT, BARREL, K_RIGHT, BARREL, size, R_EYES, 1000 * T_EYES[:, None])
    maps = [cv2.initUndistortRectifyMap(K, BARREL, R, P, size, cv2.CV_32FC1) for K, R, P in ((K_LEFT, R1, P1), (K_RIGHT, R2, P2))]
    poses = [
        published_pose(document, root, number) for number, document in sorted(read_frame_data(root / "data/frame_data.tar.gz").items())
    ]
    for number, pose in enumerate(map(np.linalg.inv, poses)):
        for eye, image, where in zip(("left", "right"), next(iter(stereo_images({0: pose}))), maps, strict=True):
            write_rgb(root / f"data/{eye}_finalpass/frame_data{number:06d}.png", cv2.remap(image, *where, cv2.INTER_LINEAR))
        if disparity:  # of the raw camera's points, without the rotation that rectifies
            x, y, z = 1000 * np.moveaxis(see_plane(K_LEFT, BARREL, pose)[1], -1, 0)
            u, v = (P1[0, 0] * x / z + P1[0, 2]).astype(int), (P1[0, 0] * y / z + P1[1, 2]).astype(int)
            inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
            values = np.zeros((HEIGHT, WIDTH), np.float32)
            values[v[inside], u[inside]] = (Q[2, 3] / Q[3, 2] / z)[inside]
            (root / "data/disparity").mkdir(exist_ok=True)
            tifffile.imwrite(root / f"data/disparity/frame_data{number:06d}.tiff", values)
    (root / "data/rgb.mp4").unlink()


@pytest.fixture
def scared(tmp_path):
    root = tmp_path / "keyframe_1"
    root.mkdir()
    return root


@pytest.mark.slow
@pytest.mark.parametrize("world_to_camera", [True, False], ids=["world_to_camera", "camera_to_world"])
def test_scared_finds_which_way_its_poses_point(scared, world_to_camera, caplog):
    write_scared(scared, world_to_camera=world_to_camera)
    with caplog.at_level(logging.INFO):
        frames = list(read_scared(scared))
    assert f"camera-pose is {'world_to_camera' if world_to_camera else 'camera_to_world'}" in caplog.text
    assert len(frames) == 6
    for frame in frames:
        assert frame.baseline == pytest.approx(np.linalg.norm(T_EYES), rel=1e-6)
        assert_frame_agrees(frame, tolerance=12)


@pytest.mark.slow
def test_scared_pose_direction_can_be_stated(scared):
    write_scared(scared)
    wrong = list(read_scared(scared, pose_direction="camera_to_world"))[-1]
    expected, _ = plane_colours(wrong)
    assert np.median(np.abs(wrong.image - expected)) > 15


@pytest.mark.slow
def test_scared_scene_points_in_any_order(scared, caplog):
    write_scared(scared, order=[3, 1, 5, 0, 2])  # frame 4 has none
    frames = list(read_scared(scared, start=1))
    assert [frame.depth is not None for frame in frames] == [True, True, True, False, True]
    for frame in frames:
        assert_frame_agrees(frame, tolerance=12)
    assert "not in its place" in caplog.text
    assert "scene_points.tar.gz: no depth for 1 of 5 frames" in caplog.text


@pytest.mark.slow
def test_scared_depth_choices(scared):
    write_scared(scared)
    keyframe = list(read_scared(scared, depth="keyframe"))
    assert [f.depth is not None for f in keyframe] == [True] + 5 * [False]
    assert (keyframe[0].depth == 0).any()  # where the keyframe has NaN
    assert_frame_agrees(keyframe[0], tolerance=12)
    assert all(f.depth is None for f in read_scared(scared, depth="none"))


@pytest.mark.slow
def test_extracted_folders_are_the_archives(scared, caplog):
    write_scared(scared)
    published = list(read_scared(scared))
    extract(scared, "frame_data", "scene_points")
    (scared / "data/frame_data/notes.json").write_text("{}")  # has no number
    for frame, expected in zip(open_sequence(scared), published, strict=True):
        np.testing.assert_array_equal(frame.image, expected.image)
        np.testing.assert_array_equal(frame.depth, expected.depth)
        np.testing.assert_array_equal(frame.camera.pose, expected.camera.pose)
    assert "no image there" not in caplog.text
    (scared / "data/scene_points/scene_points000002.tiff").unlink()
    read_scared(scared)
    assert "data/scene_points: no image there for 1 of 6 frames" in caplog.text
    (scared / "data/scene_points/scene_points000003.tiff").write_bytes(b"no tiff")
    with pytest.raises(SequenceError, match="scene_points000003.tiff: not a readable TIFF"):
        list(read_scared(scared))
    (scared / "data/frame_data/frame_data000001.json").write_text("{")
    with pytest.raises(SequenceError, match="data/frame_data: frame_data000001.json is not valid JSON"):
        read_scared(scared)


@pytest.mark.slow
@pytest.mark.parametrize("extracted", [False, True], ids=["archives", "folders"])
def test_images_that_are_rectified_already_are_not_rectified_again(scared, extracted, caplog):
    write_scared(scared)
    preprocess(scared)
    if extracted:
        extract(scared, "frame_data", "scene_points")
    with caplog.at_level(logging.INFO):
        frames = list(open_sequence(scared))
    assert "camera-pose is world_to_camera" in caplog.text
    assert len(frames) == 6
    for frame in frames:
        assert frame.baseline == pytest.approx(np.linalg.norm(T_EYES), rel=1e-6)
        assert_frame_agrees(frame, tolerance=12)


@pytest.mark.slow
def test_disparity_is_read_where_there_are_no_points(scared, caplog):
    write_scared(scared, count=2)
    preprocess(scared, disparity=True)
    (scared / "data/scene_points.tar.gz").unlink()
    for frame in read_scared(scared):
        _, depth = plane_colours(frame)
        measured = frame.depth > 0
        assert measured.mean() > 0.5
        assert np.median(np.abs(frame.depth / depth - 1)[measured]) < 0.05
    assert "depth comes from data/disparity" in caplog.text
    tifffile.imwrite(scared / "data/disparity/frame_data000001.tiff", np.zeros((8, 8), np.float32))
    with pytest.raises(SequenceError, match="frame_data000001.tiff: expected disparity of shape"):
        list(read_scared(scared))


@pytest.mark.slow
def test_poses_can_be_estimated_instead_of_the_published(scared, monkeypatch):
    write_scared(scared)
    asked = []
    monkeypatch.setattr(scared_reader, "with_estimated_poses", lambda recording, *how: asked.append(how) or recording)
    frames = list(read_scared(scared, poses="sfm"))
    assert [how[:2] for how in asked] == [(scared, "sfm")] and len(frames) == 6
    assert all(np.array_equal(frame.camera.pose, frames[0].camera.pose) for frame in frames)


@pytest.mark.slow
def test_correlation_that_is_no_number_decides_nothing(scared, caplog):
    write_scared(scared)
    poses = {n: published_pose(document, scared, n) for n, document in read_frame_data(scared / "data/frame_data.tar.gz").items()}
    images, keyframe = StackedVideo(scared / "data/rgb.mp4"), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    points = np.dstack([np.zeros((HEIGHT, WIDTH, 2)), np.full((HEIGHT, WIDTH), 0.08)])
    monkey = pytest.MonkeyPatch()
    monkey.setattr("endo_sim_ros.sequences.scared_pose_direction._correlation", lambda a, b: float("nan"))
    project = lambda local: 40 * local[:, :2] / local[:, 2:] + [80, 64] + 1000 * local[:, :2]
    assert find_pose_direction(points, keyframe, images, poses, project, scared) == "world_to_camera"
    monkey.undo()
    assert "cannot be verified, as too few of the keyframe's points fall into pictures with contrast; assuming" in caplog.text


@pytest.mark.slow
def test_images_that_are_counted_from_1_beside_poses_from_0_are_told(scared, caplog):
    write_scared(scared, count=2)
    preprocess(scared)
    for eye in ("left", "right"):
        for number in (1, 0):
            path = scared / f"data/{eye}_finalpass/frame_data{number:06d}.png"
            path.rename(path.with_name(f"frame_data{number + 1:06d}.png"))
    read_scared(scared, pose_direction="world_to_camera")
    assert "frame_data.tar.gz: its numbers begin with 0, those of the images with 1" in caplog.text


def test_poses_that_fit_the_images_in_no_direction_are_told(scared, caplog):
    rng = np.random.default_rng(0)
    points = np.stack([*np.meshgrid(np.linspace(-0.1, 0.1, WIDTH), np.linspace(-0.08, 0.08, HEIGHT)), np.full((HEIGHT, WIDTH), 0.1)], -1)
    noise = rng.integers(0, 255, (8, HEIGHT, WIDTH, 3), np.uint8)  # what is seen has nothing to do with the keyframe
    turned = {n: rigid_pose(Rotation.from_rotvec([0, 0.02 * n, 0]).as_matrix(), np.zeros(3)) for n in range(1, 7)}
    images = SimpleNamespace(numbers=range(7), size=(WIDTH, HEIGHT), read=lambda numbers: ((n, noise[n], noise[n]) for n in numbers))
    project = lambda local: 80 * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]
    assert find_pose_direction(points, noise[7], images, turned, project, scared) == "world_to_camera"
    assert "neither pose direction fits the images" in caplog.text


@pytest.mark.slow
def test_an_empty_depth_map_verifies_no_pose_direction(scared, caplog):
    write_scared(scared)
    cv2.imwrite(str(scared / "left_depth_map.tiff"), np.full((HEIGHT, WIDTH, 3), np.nan, np.float32))
    assert len(list(read_scared(scared, stop=2))) == 2
    assert "depth map is empty and cannot verify the pose direction; assuming world_to_camera" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "told"), [("dataset_4/keyframe_1", True), ("dataset_5_keyframe_2", True), ("dataset_1/keyframe_4", False)]
)
def test_known_defects_are_told(tmp_path, folder, told, caplog):
    root = tmp_path / folder
    root.mkdir(parents=True)
    write_scared(root, count=1)
    read_scared(root)
    assert ("is known to be wrong" in caplog.text) == told


@pytest.mark.slow
def test_scared_keyframe_alone(scared, caplog):
    caplog.set_level("INFO")
    write_scared(scared)
    (scared / "data/rgb.mp4").unlink()
    frames = list(open_sequence(scared))
    assert len(frames) == 1 and frames[0].stamp_ns == 1_000_000_000
    assert "so the keyframe alone is read" in caplog.text
    assert_frame_agrees(frames[0])


@pytest.mark.slow
def test_scared_calibration_from_frame_data(scared):
    write_scared(scared, yaml=False)
    for frame in read_scared(scared, stop=2):
        assert_frame_agrees(frame, tolerance=12)


@pytest.mark.slow
def test_scared_warns_when_the_camera_does_not_move(scared, caplog):
    write_scared(scared, count=1)
    assert len(list(read_scared(scared))) == 1
    assert "moves too little" in caplog.text


def damage_json(root: Path, data: bytes):
    with tarfile.open(root / "data/frame_data.tar.gz", "w:gz", compresslevel=1) as tar:
        add_member(tar, "frame_data000000.json", data)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda r: (r / "endoscope_calibration.yaml").write_text("%YAML:1.0\n---\nM1: 3\n"),
            "endoscope_calibration.yaml: ",
        ),
        (lambda r: (r / "endoscope_calibration.yaml").write_text("nonsense"), "endoscope_calibration.yaml: "),
        (lambda r: (r / "data/frame_data.tar.gz").write_bytes(b"no archive"), "frame_data.tar.gz: not a readable"),
        (lambda r: damage_json(r, b"{"), "frame_data000000.json is not valid JSON"),
        (lambda r: damage_json(r, b"[]"), "camera-pose of frame 0 is missing"),
        (
            lambda r: damage_json(r, b'{"camera-pose": [[NaN,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}'),
            "camera-pose of frame 0: expected a finite 4×4 matrix, got one that is not finite",
        ),
        (
            lambda r: (r / "data/frame_data.tar.gz").write_bytes((r / "data/frame_data.tar.gz").read_bytes()[:400]),
            "frame_data.tar.gz: not a read",
        ),
        (lambda r: damage_json(r, b'{"camera-pose": [[1]]}'), r"camera-pose of frame 0: expected a finite 4×4 matrix, got shape \(1, 1\)"),
        (lambda r: damage_json(r, b" " * (2 << 20)), "far more than a camera needs"),
        (lambda r: (r / "data/scene_points.tar.gz").write_bytes(b"no archive"), "scene_points.tar.gz: not a readable"),
        (lambda r: (r / "left_depth_map.tiff").write_bytes(b"no tiff"), "left_depth_map.tiff: not a readable TIFF"),
        (
            lambda r: tifffile.imwrite(r / "left_depth_map.tiff", np.zeros((8, 8, 3), np.float32), photometric="rgb"),
            "expected points of shape",
        ),
        (lambda r: (r / "data/rgb.mp4").write_bytes(b"no video"), "rgb.mp4: not a readable video"),
    ],
)
def test_damaged_scared_is_refused_by_name(scared, damage, message):
    write_scared(scared, count=2)
    damage(scared)
    with pytest.raises(SequenceError, match=message):
        list(read_scared(scared))


@pytest.mark.slow
def test_truncated_scene_points_are_refused_by_name(scared):
    write_scared(scared, count=3)
    archive = scared / "data/scene_points.tar.gz"
    archive.write_bytes(archive.read_bytes()[: archive.stat().st_size // 2])
    with pytest.raises(SequenceError, match=r"scene_points.tar.gz: not a readable"):
        list(read_scared(scared))


def test_an_archive_that_is_cut_off_anywhere_is_refused(tmp_path):
    archive, documents = tmp_path / "frame_data.tar.gz", {n: {"noise": list(np.random.default_rng(n).random(20))} for n in range(6)}
    with tarfile.open(archive, "w:gz", compresslevel=1) as tar:
        for number, document in documents.items():
            add_member(tar, f"frame_data{number:06d}.json", json.dumps(document).encode())
    assert read_frame_data(archive) == documents
    whole = archive.read_bytes()
    for count in range(0, len(whole), 7):  # tarfile takes a header that is cut off for the end
        archive.write_bytes(whole[:count])
        with pytest.raises(SequenceError, match="frame_data.tar.gz: not a readable"):
            read_frame_data(archive)


@pytest.mark.slow
def test_links_in_archives_are_not_followed(scared):
    write_scared(scared, count=1)
    link = tarfile.TarInfo("frame_data000000.json")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    with tarfile.open(scared / "data/frame_data.tar.gz", "w:gz", compresslevel=1) as tar:
        tar.addfile(link)
    with pytest.raises(SequenceError, match="holds no frame_data"):
        read_scared(scared)


@pytest.mark.slow
def test_scared_dataset_folder_lists_its_keyframes(scared):
    write_scared(scared, count=1)
    with pytest.raises(SequenceError, match="pass one of its keyframes: keyframe_1"):
        open_sequence(scared.parent)


@pytest.mark.slow
def test_a_pose_that_is_none_matters_only_where_its_frame_is_asked_for(scared):
    write_scared(scared, count=3)
    extract(scared, "frame_data")
    file = scared / "data/frame_data/frame_data000000.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"camera-pose": np.full((4, 4), np.nan).tolist()}))
    assert len(list(read_scared(scared, start=1))) == 2
    with pytest.raises(SequenceError, match="camera-pose of frame 0: expected a finite"):
        read_scared(scared)
