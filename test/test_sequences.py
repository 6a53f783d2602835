"""The dataset readers, on small exact copies of each layout: a known textured plane seen by known cameras."""

import io
import itertools
import json
import logging
import shutil
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from endo_sim_ros.core.cameras import Camera, matrix_to_quat
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.endonerf import read_endonerf
from endo_sim_ros.sequences.folder import read_folder, read_points
from endo_sim_ros.sequences.readers import READERS, open_sequence
from endo_sim_ros.sequences.recordings import Video, lit_area, lit_now, numbered_files, read_poses, tool_is_white
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration
from endo_sim_ros.sequences.scared import read_scared
from endo_sim_ros.sequences.stereomis import read_stereomis
from endo_sim_ros.sequences.structure_from_motion import estimate_poses
from endo_sim_ros.sequences.video import read_video

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"

WIDTH, HEIGHT = 160, 128
PLANE_Z = 0.08  # m, in the world frame
K_LEFT = np.array([[150.0, 0, 78.0], [0, 152.0, 65.0], [0, 0, 1]])
K_RIGHT = np.array([[149.0, 0, 81.0], [0, 151.0, 62.0], [0, 0, 1]])
NO_DISTORTION = np.zeros(5)
BARREL = np.array([-0.2, 0.03, 0.001, -0.002, 0.0])
BASELINE = 0.005


def rotation(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    return cv2.Rodrigues(np.array([x, y, z], np.float64))[0]


def pose_of(position=(0, 0, 0), x=0.0, y=0.0, z=0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(x, y, z), position
    return pose


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """RGB of the plane at world points, smooth, so that video compression and interpolation change it little."""
    red = 120 + 60 * np.sin(2 * np.pi * x / 0.023) * np.cos(2 * np.pi * y / 0.031)
    green = 110 + 50 * np.sin(2 * np.pi * (x + 0.4 * y) / 0.017)
    blue = 80 + 40 * np.cos(2 * np.pi * (y - 0.3 * x) / 0.019)
    return np.stack([red, green, blue], -1)


def see_plane(K_cv, distortion, pose) -> tuple[np.ndarray, np.ndarray]:
    """What a raw camera (OpenCV pixel convention) sees: RGB [H, W, 3] and points [H, W, 3] in its own frame."""
    u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64))
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, K_cv, distortion, criteria=(3, 100, 1e-12)).reshape(HEIGHT, WIDTH, 2)
    rays = np.dstack([rays, np.ones_like(u)])
    turned = rays @ pose[:3, :3].T
    depth = (PLANE_Z - pose[2, 3]) / turned[..., 2]
    points = turned * depth[..., None] + pose[:3, 3]
    return texture(points[..., 0], points[..., 1]).round().astype(np.uint8), rays * depth[..., None]


def right_pose(left: np.ndarray, R: np.ndarray, T: np.ndarray) -> np.ndarray:
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = R, T
    return left @ np.linalg.inv(change)


def plane_colours(frame) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H, W, 3] and depth [H, W] that the frame's own camera says the plane must have."""
    camera = frame.camera
    turned = camera.rays() @ camera.pose[:3, :3].T
    depth = (PLANE_Z - camera.pose[2, 3]) / turned[..., 2]
    points = turned * depth[..., None] + camera.pose[:3, 3]
    return texture(points[..., 0], points[..., 1]), depth


def assert_frame_agrees(frame, tolerance=4.0, margin=4):
    """The image shows what K and pose say; the right image shows it shifted by fx·baseline/depth on the same row."""
    expected, depth = plane_colours(frame)
    used = cv2.erode(frame.mask, np.ones((2 * margin + 1,) * 2)) > 0 if frame.mask is not None else np.ones(depth.shape, bool)
    used[:margin] = used[-margin:] = False
    assert used.mean() > 0.3
    error = np.abs(frame.image.astype(float) - expected).max(-1)[used]
    assert np.median(error) < tolerance / 2
    assert np.percentile(error, 95) < tolerance
    if frame.right is not None:
        disparity = frame.camera.K[0, 0] * frame.baseline / depth
        u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        moved = cv2.remap(frame.right, (u - disparity).astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        used &= u - disparity > margin
        error = np.abs(moved.astype(float) - expected).max(-1)[used]
        assert np.percentile(error, 95) < tolerance
    if frame.depth is not None:
        measured = (frame.depth > 0) & used
        assert measured.any()
        assert np.abs(frame.depth - depth)[measured].max() < 5.1e-4  # depth images are rounded to millimetres


def write_rgb(path: Path, image: np.ndarray):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_video(path: Path, images, fps=25.0):
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = None
    for image in images:
        writer = writer or cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), fps, image.shape[1::-1])
        assert writer.isOpened()
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()


def write_poses(path: Path, poses: dict[int, np.ndarray], heading="# frame tx ty tz qx qy qz qw"):
    lines = [heading]
    for number, pose in poses.items():
        w, x, y, z = matrix_to_quat(pose[:3, :3])
        lines.append(f"{number} " + " ".join(f"{value:.12g}" for value in (*pose[:3, 3], x, y, z, w)))
    path.write_text("\n".join(lines) + "\n")


def trajectory(count: int) -> dict[int, np.ndarray]:
    return {n: pose_of((0.001 * n, -0.0005 * n, 0.0004 * n), x=0.004 * n, y=-0.006 * n, z=0.003 * n) for n in range(count)}


# ---------------------------------------------------------------------------------------------------- rectification


@pytest.mark.parametrize("distortion", [NO_DISTORTION, BARREL], ids=["undistorted", "barrel"])
def test_rectified_eyes_share_rows_and_their_disparity_gives_depth(distortion):
    R, T = rotation(0.02, -0.03, 0.015), np.array([-BASELINE, 0.0003, -0.0002])
    rectification = Rectification.stereo(StereoCalibration("calibration", (WIDTH, HEIGHT), K_LEFT, distortion, K_RIGHT, distortion, R, T))
    pose = pose_of((0.004, -0.002, 0.01), x=0.1, y=-0.15, z=0.2)
    left, points = see_plane(K_LEFT, distortion, pose)
    right, _ = see_plane(K_RIGHT, distortion, right_pose(pose, R, T))

    frame = Frame(
        stamp_ns=1,
        image=rectification.left(left),
        camera=Camera(rectification.K, WIDTH, HEIGHT, rectification.pose(pose)),
        right=rectification.right(right),
        baseline=rectification.baseline,
        depth=rectification.depth(points),
        mask=rectification.mask(None),
    )
    assert rectification.baseline == pytest.approx(np.linalg.norm(T), rel=1e-9)
    assert_frame_agrees(frame)


def test_right_pose_instead_of_change_of_coordinates_is_recognised(caplog):
    R, T = rotation(0.01, 0.02, 0), np.array([-BASELINE, 0.0002, 0.0001])
    arguments = ("calibration", (WIDTH, HEIGHT), K_LEFT, NO_DISTORTION, K_RIGHT, NO_DISTORTION)
    usual = StereoCalibration(*arguments, R, T)
    inverse = StereoCalibration(*arguments, R.T, -R.T @ T)
    np.testing.assert_allclose(inverse.R, usual.R, atol=1e-12)
    np.testing.assert_allclose(inverse.T, usual.T, atol=1e-12)
    assert "pose in the left frame" in caplog.text


def test_pixels_outside_the_raw_image_are_masked():
    pincushion = np.array([0.3, 0, 0, 0, 0])
    rectification = Rectification.stereo(
        StereoCalibration(
            "c",
            (WIDTH, HEIGHT),
            K_LEFT,
            pincushion,
            K_RIGHT,
            pincushion,
            rotation(0.2, 0, 0.1),
            np.array([-BASELINE, 0, 0]),
        )
    )
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    black = rectification.left(white).max(-1) == 0
    assert not rectification.valid[black].any()


def test_mono_undistortion_shows_what_its_pinhole_says():
    rectification = Rectification.mono(K_LEFT + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], BARREL, (WIDTH, HEIGHT))
    pose = pose_of((0.002, 0.001, 0), y=0.1)
    image, points = see_plane(K_LEFT, BARREL, pose)
    camera = Camera(rectification.K, WIDTH, HEIGHT, rectification.pose(pose))
    frame = Frame(1, rectification.left(image), camera, depth=rectification.depth(points), mask=rectification.valid)
    assert_frame_agrees(frame)


def test_depth_without_measurement_stays_zero():
    rectification = Rectification.mono(K_LEFT, (), (WIDTH, HEIGHT))
    points = np.full((HEIGHT, WIDTH, 3), 0.1, np.float32)
    points[0, 0] = np.nan
    points[1, 1] = 0
    points[2, 2] = [0, 0, -1]
    depth = rectification.depth(points)
    assert depth[0, 0] == depth[1, 1] == depth[2, 2] == 0
    assert depth[5, 5] == pytest.approx(0.1)
    assert depth.dtype == np.float32


# -------------------------------------------------------------------------------------------------------- StereoMIS

R_EYES, T_EYES = rotation(0.01, -0.02, 0.005), np.array([-BASELINE, 0.0002, 0.0001])


def stereo_images(poses: dict[int, np.ndarray], distortion=BARREL):
    for pose in poses.values():
        left, _ = see_plane(K_LEFT, distortion, pose)
        right, _ = see_plane(K_RIGHT, distortion, right_pose(pose, R_EYES, T_EYES))
        yield left, right


def write_ini(path: Path):
    lines = []
    for section, K in (("StereoLeft", K_LEFT), ("StereoRight", K_RIGHT)):
        lines += [f"[{section}]", f"res_x={WIDTH}", f"res_y={HEIGHT}", f"fc_x={K[0, 0]}", f"fc_y={K[1, 1]}"]
        lines += [f"cc_x={K[0, 2]}", f"cc_y={K[1, 2]}"] + [f"kc_{i}={k}" for i, k in enumerate(BARREL)]
    lines += [f"R_{i}={value:.12g}" for i, value in enumerate(R_EYES.ravel())]
    lines += [f"T_{i}={1000 * value:.12g}" for i, value in enumerate(T_EYES)]
    path.write_text("\n".join(lines))


@pytest.fixture(scope="module")
def stereomis_source(tmp_path_factory):
    root = tmp_path_factory.mktemp("stereomis") / "P1"
    root.mkdir()
    poses = trajectory(8)
    write_ini(root / "StereoCalibration.ini")
    write_video(root / "IFBS_ENDOSCOPE-part0001.mp4", (np.vstack(pair) for pair in stereo_images(poses)), fps=20.0)
    write_poses(root / "groundtruth.txt", {n: pose for n, pose in poses.items() if n != 3})
    (root / "train_split.csv").write_text("start,end\n0,1\n4,5\n")
    (root / "test_split.csv").write_text("start,end\n6,7\n")
    for number in (0, 4):
        tool = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
        tool[30:50, 30:] = 255
        write_rgb(root / f"masks/{number:06d}l.png", tool)
    return root


@pytest.fixture
def stereomis(stereomis_source, tmp_path):
    """A copy that a test may damage."""
    return Path(shutil.copytree(stereomis_source, tmp_path / "P1"))


def test_stereomis_frames_are_rectified_posed_and_timed(stereomis_source):
    frames = list(read_stereomis(stereomis_source))
    assert len(frames) == len(read_stereomis(stereomis_source)) == 7  # frame 3 has no pose
    assert [f.stamp_ns for f in frames] == [1_000_000_000 + n * 50_000_000 for n in (0, 1, 2, 4, 5, 6, 7)]
    for frame in frames:
        assert frame.baseline == pytest.approx(np.linalg.norm(T_EYES), rel=1e-6)
        assert frame.image.dtype == np.uint8 and frame.mask.dtype == np.uint8
        assert_frame_agrees(frame, tolerance=12)


def test_stereomis_counts_frames_without_pose_in_the_log(stereomis_source, caplog):
    with caplog.at_level(logging.INFO):
        read_stereomis(stereomis_source)
    assert "groundtruth.txt: 1 of 8 frames have no pose" in caplog.text
    assert "white is taken for tools" in caplog.text


@pytest.mark.parametrize(("split", "numbers"), [("train", [0, 1, 4, 5]), ("test", [6, 7]), (None, [0, 1, 2, 4, 5, 6, 7])])
def test_stereomis_splits_are_inclusive_ranges(stereomis_source, split, numbers):
    frames = read_stereomis(stereomis_source, split=split)
    assert [(f.stamp_ns - 1_000_000_000) // 50_000_000 for f in frames] == numbers


def test_stereomis_range_and_step(stereomis_source):
    frames = read_stereomis(stereomis_source, start=1, stop=7, step=2)
    assert [(f.stamp_ns - 1_000_000_000) // 50_000_000 for f in frames] == [1, 5]  # 3 has no pose


def test_stereomis_mask_ignores_the_tool_at_full_resolution_and_is_borrowed_from_a_neighbour(stereomis_source):
    frames = {(f.stamp_ns - 1_000_000_000) // 50_000_000: f for f in read_stereomis(stereomis_source)}
    for number in (0, 1, 4, 5):
        mask = frames[number].mask
        assert mask.shape == (HEIGHT, WIDTH) and set(np.unique(mask)) == {0, 255}
        assert mask[80, 120] == 0  # the tool
        assert mask[20, 80] == 255
    assert frames[2].mask[80, 120] == frames[7].mask[80, 120] == 255  # no mask within one frame


def test_stereomis_masks_of_either_polarity_mean_the_same(stereomis):
    usual = [f.mask for f in read_stereomis(stereomis)]
    for path in (stereomis / "masks").glob("*.png"):
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    for mask, inverted in zip(usual, (f.mask for f in read_stereomis(stereomis)), strict=True):
        np.testing.assert_array_equal(mask, inverted)
    forced = next(iter(read_stereomis(stereomis, mask_polarity="tool"))).mask
    assert forced[80, 120] == 255 and forced[20, 80] == 0


def test_stereomis_extracted_frames_equal_the_video(stereomis):
    next(stereomis.glob("*.mp4")).unlink()
    for number, (left, right) in enumerate(stereo_images(trajectory(8))):
        write_rgb(stereomis / f"video_frames/{number:06d}l.png", left)
        write_rgb(stereomis / f"video_frames/{number:06d}r.png", right)
    frames = list(read_stereomis(stereomis))
    assert len(frames) == 7
    assert frames[1].stamp_ns - frames[0].stamp_ns == 40_000_000  # extracted frames have no rate; 25 Hz
    for frame in frames:
        assert_frame_agrees(frame)


def test_intrinsics_follow_images_of_another_resolution(stereomis):
    next(stereomis.glob("*.mp4")).unlink()
    for number, pair in enumerate(stereo_images(trajectory(2))):
        for eye, image in zip("lr", pair, strict=True):
            write_rgb(stereomis / f"video_frames/{number:06d}{eye}.png", cv2.resize(image, None, fx=2, fy=2))
    frame = next(iter(read_stereomis(stereomis)))
    assert frame.image.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    expected, _ = plane_colours(frame)
    assert np.median(np.abs(frame.image - expected)) < 3


def test_reading_is_lazy_and_repeatable(stereomis):
    recording = read_stereomis(stereomis, mask_polarity="tool")
    first = next(iter(recording))
    (stereomis / "masks/000004l.png").write_bytes(b"damaged")
    assert next(iter(recording)).stamp_ns == first.stamp_ns
    with pytest.raises(SequenceError, match="000004l.png"):
        list(recording)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("StereoCalibration.ini", None, "StereoCalibration.ini: file is missing"),
        (
            "StereoCalibration.ini",
            "[StereoLeft]\nres_x=1\nres_y=1\nfc_x=5",
            r"StereoCalibration.ini: \[StereoLeft\] fc_y",
        ),
        ("StereoCalibration.ini", "no ini at all", "StereoCalibration.ini: not a readable ini"),
        ("groundtruth.txt", "0 0 0 0 0 0 1", "groundtruth.txt: line 1 has 7 numbers, expected 8"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 0", "groundtruth.txt: line 1 is not a pose"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\n0 0 0 nan 0 0 0 1", "groundtruth.txt: line 2 is not a pose"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\n0 0 0 1 0 0 0 1", "groundtruth.txt: line 2 repeats frame 0"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\nx y", "groundtruth.txt: line 2 is not made of numbers"),
        ("groundtruth.txt", "", "groundtruth.txt: holds no poses"),
        ("groundtruth.txt", "99 0 0 0 0 0 0 1", "groundtruth.txt: holds no pose for any of the 8"),
        ("IFBS_ENDOSCOPE-part0001.mp4", "not a video", "part0001.mp4: not a readable video"),
        ("IFBS_ENDOSCOPE-part0001.mp4", None, "holds neither a video"),
        ("second.mp4", "", "more than one video"),
        ("train_split.csv", "start,end\n9,2\n", "train_split.csv: line 2 is not a range"),
        ("train_split.csv", None, "train_split.csv: file is missing"),
    ],
)
def test_damaged_stereomis_is_refused_by_name(stereomis, name, text, message):
    (stereomis / name).unlink(missing_ok=True)
    if text is not None:
        (stereomis / name).write_text(text)
    with pytest.raises(SequenceError, match=message):
        read_stereomis(stereomis, split="train" if "split" in name else None)


# ----------------------------------------------------------------------------------------------------------- SCARED


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
    with tarfile.open(root / "data/frame_data.tar.gz", "w:gz") as tar:
        for number, pose in poses.items():
            matrix = np.linalg.inv(pose) if world_to_camera else pose.copy()
            matrix[:3, 3] *= 1000
            document = {"camera-pose": matrix.tolist(), "camera-calibration": calibration, "timestamp": 0}
            add_member(tar, f"frame_data{number:06d}.json", json.dumps(document).encode())
    with tarfile.open(root / "data/scene_points.tar.gz", "w:gz") as tar:
        for number in order or range(count):
            _, points = see_plane(K_LEFT, BARREL, poses[number])
            add_member(tar, f"./scene_points{number:06d}.tiff", tiff_bytes(1000 * np.vstack([points, points])))
    return root


@pytest.fixture
def scared(tmp_path):
    root = tmp_path / "keyframe_1"
    root.mkdir()
    return root


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


def test_scared_pose_direction_can_be_stated(scared):
    write_scared(scared)
    wrong = list(read_scared(scared, pose_direction="camera_to_world"))[-1]
    expected, _ = plane_colours(wrong)
    assert np.median(np.abs(wrong.image - expected)) > 15


def test_scared_scene_points_in_any_order(scared, caplog):
    write_scared(scared, order=[3, 1, 5, 0, 2])  # frame 4 has none
    frames = list(read_scared(scared, start=1))
    assert [frame.depth is not None for frame in frames] == [True, True, True, False, True]
    for frame in frames:
        assert_frame_agrees(frame, tolerance=12)
    assert "not in its place" in caplog.text


def test_scared_depth_choices(scared):
    write_scared(scared)
    keyframe = list(read_scared(scared, depth="keyframe"))
    assert [f.depth is not None for f in keyframe] == [True] + 5 * [False]
    assert (keyframe[0].depth == 0).any()  # where the keyframe has NaN
    assert_frame_agrees(keyframe[0], tolerance=12)
    assert all(f.depth is None for f in read_scared(scared, depth="none"))


def test_scared_keyframe_alone(scared):
    write_scared(scared)
    (scared / "data/rgb.mp4").unlink()
    frames = list(open_sequence(scared))
    assert len(frames) == 1 and frames[0].stamp_ns == 1_000_000_000
    assert_frame_agrees(frames[0])


def test_scared_calibration_from_frame_data(scared):
    write_scared(scared, yaml=False)
    for frame in read_scared(scared, stop=2):
        assert_frame_agrees(frame, tolerance=12)


def test_scared_warns_when_the_camera_does_not_move(scared, caplog):
    write_scared(scared, count=1)
    assert len(list(read_scared(scared))) == 1
    assert "moves too little" in caplog.text


def damage_json(root: Path, data: bytes):
    with tarfile.open(root / "data/frame_data.tar.gz", "w:gz") as tar:
        add_member(tar, "frame_data000000.json", data)


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
        (lambda r: damage_json(r, b'{"camera-pose": [[1]]}'), "camera-pose of frame 0: expected a finite 4×4"),
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


def test_truncated_scene_points_are_refused_by_name(scared):
    write_scared(scared, count=3)
    archive = scared / "data/scene_points.tar.gz"
    archive.write_bytes(archive.read_bytes()[: archive.stat().st_size // 2])
    with pytest.raises(SequenceError, match=r"scene_points.tar.gz: not a readable"):
        list(read_scared(scared))


def test_links_in_archives_are_not_followed(scared):
    write_scared(scared, count=1)
    link = tarfile.TarInfo("frame_data000000.json")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    with tarfile.open(scared / "data/frame_data.tar.gz", "w:gz") as tar:
        tar.addfile(link)
    with pytest.raises(SequenceError, match="holds no frame_data"):
        read_scared(scared)


def test_scared_dataset_folder_lists_its_keyframes(scared):
    write_scared(scared, count=1)
    with pytest.raises(SequenceError, match="pass one of its keyframes: keyframe_1"):
        open_sequence(scared.parent)


# --------------------------------------------------------------------------------------------------------- EndoNeRF


@pytest.fixture
def endonerf(tmp_path):
    """Positions and depth in millimetres; focal length for images of twice the size."""
    root = tmp_path / "pulling"
    root.mkdir()
    K = np.array([[150.0, 0, WIDTH / 2 - 0.5], [0, 150.0, HEIGHT / 2 - 0.5], [0, 0, 1]])
    rows = []
    for number, pose in trajectory(4).items():
        image, points = see_plane(K, NO_DISTORTION, pose)
        write_rgb(root / f"images/{number:06d}.png", image)
        write_rgb(root / f"depth/{number:06d}.png", (1000 * points[..., 2]).round().astype(np.uint16))
        tool = np.zeros((HEIGHT, WIDTH), np.uint8)
        tool[90:, 100:] = 255
        write_rgb(root / f"masks/{number:06d}.png", tool)
        x, y, z = pose[:3, :3].T
        hwf = [2 * HEIGHT, 2 * WIDTH, 300.0]
        block = np.stack([y, x, -z, 1000 * pose[:3, 3], hwf], 1)  # LLFF: down, right, back
        rows.append(np.concatenate([block.ravel(), [50.0, 120.0]]))
    np.save(root / "poses_bounds.npy", np.array(rows))
    return root


def test_endonerf_frames_are_posed_in_metres_with_tools_masked(endonerf):
    frames = list(open_sequence(endonerf))
    assert len(frames) == 4 and frames[1].stamp_ns == 1_040_000_000
    for frame, pose in zip(frames, trajectory(4).values(), strict=True):
        np.testing.assert_allclose(frame.camera.pose, pose, atol=1e-9)
        assert frame.mask[120, 150] == 0 and frame.mask[20, 20] == 255
        assert frame.depth.dtype == np.float32
        expected, depth = plane_colours(frame)
        assert np.abs(frame.image - expected).max() < 1
        assert np.abs(frame.depth - depth).max() < 6e-4  # rounded to millimetres


def test_endonerf_scales_can_be_stated(endonerf):
    frame = list(read_endonerf(endonerf, depth_scale=1e-2, pose_scale=2e-3))[2]
    np.testing.assert_allclose(frame.camera.position, 2 * trajectory(3)[2][:3, 3], atol=1e-9)
    assert np.median(frame.depth) == pytest.approx(0.8, rel=0.05)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: (r / "poses_bounds.npy").unlink(), "poses_bounds.npy: file is missing"),
        (lambda r: (r / "poses_bounds.npy").write_bytes(b"x"), "poses_bounds.npy: not a readable NumPy array"),
        (
            lambda r: (r / "poses_bounds.npy").write_bytes(
                (r / "poses_bounds.npy").read_bytes().replace(b"(4, 17)", b"(9999999999, 17)")[:128] + bytes(100)
            ),
            "poses_bounds.npy: not a readable NumPy array",
        ),
        (lambda r: np.save(r / "poses_bounds.npy", np.array([{}])), "poses_bounds.npy: not a readable NumPy array"),
        (lambda r: np.save(r / "poses_bounds.npy", np.ones((4, 15))), r"shape \[frames, 17\], got shape \[4, 15\]"),
        (lambda r: np.save(r / "poses_bounds.npy", np.ones((3, 17))), "has 3 poses, but .* has 4 images"),
        (
            lambda r: np.save(r / "poses_bounds.npy", np.ones((4, 17))),
            "row of frame 0: its 3×3 block is not a rotation",
        ),
        (lambda r: (r / "images/000002.png").write_bytes(b"x"), "000002.png: not a readable image"),
        (lambda r: write_rgb(r / "depth/000001.png", np.ones((8, 8), np.uint16)), "depth/000001.png: is 8×8"),
    ],
)
def test_damaged_endonerf_is_refused_by_name(endonerf, damage, message):
    damage(endonerf)
    with pytest.raises(SequenceError, match=message):
        list(read_endonerf(endonerf))


# ---------------------------------------------------------------------------------------------------- image folders

CALIBRATION = f"width: {WIDTH}\nheight: {HEIGHT}\nfx: 150\nfy: 150\ncx: {WIDTH / 2}\ncy: {HEIGHT / 2}\n"


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "recording"
    root.mkdir()
    K = np.array([[150.0, 0, WIDTH / 2 - 0.5], [0, 150.0, HEIGHT / 2 - 0.5], [0, 0, 1]])
    poses = dict(zip((1, 51, 101), trajectory(3).values(), strict=True))
    for number, pose in poses.items():
        left, points = see_plane(K, NO_DISTORTION, pose)
        right, _ = see_plane(K, NO_DISTORTION, right_pose(pose, np.eye(3), np.array([-BASELINE, 0, 0])))
        left[:, : 15 if number == 101 else 12] = 3  # a border, which wanders
        write_rgb(root / f"left/{number:05d}.png", left)
        write_rgb(root / f"right/{number:05d}.png", right)
        write_rgb(root / f"depth/{number:05d}.png", (1000 * points[..., 2]).round().astype(np.uint16))
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:30] = 0
    write_rgb(root / "masks/00051.png", mask)
    (root / "calibration.yaml").write_text(CALIBRATION + f"baseline_m: {BASELINE}\n")
    write_poses(root / "poses_left.txt", poses)
    return root


def test_image_folder_frames(folder):
    frames = list(open_sequence(folder))
    assert [f.stamp_ns for f in frames] == [1_040_000_000, 3_040_000_000, 5_040_000_000]
    for frame in frames:
        assert frame.baseline == BASELINE
        assert not frame.mask[:, :12].any()
        assert_frame_agrees(frame)
    assert not frames[1].mask[:30].any() and frames[0].mask[10, 80] == frames[1].mask[60, 80] == 255
    assert frames[0].mask[60, 14] == 255 and not frames[2].mask[:, :15].any()


def test_points_of_a_folder_are_those_of_its_poses(folder):
    assert read_points(folder) is None
    (folder / "points.txt").write_text("# x y z r g b track\n0.01 0.02 0.1 255 0 51 7\n0 0 0.2 0 0 0 2\n")
    points, colors = read_points(folder)
    np.testing.assert_allclose(points, [[0.01, 0.02, 0.1], [0, 0, 0.2]])
    np.testing.assert_allclose(colors, [[1, 0, 0.2], [0, 0, 0]])
    for text, reason in (("1 2 3\n", "not lines of x y z r g b"), ("0 0 nan 1 1 1\n", "finite"), ("0 0 1 300 1 1\n", "0 to 255")):
        (folder / "points.txt").write_text(text)
        with pytest.raises(SequenceError, match=f"points.txt: .*{reason}"):
            read_points(folder)
    (folder / "poses_left.txt").unlink()
    assert read_points(folder) is None


def test_image_folder_with_left_images_only(folder):
    shutil.rmtree(folder / "right")
    shutil.rmtree(folder / "depth")
    (folder / "calibration.yaml").write_text(CALIBRATION)
    frames = list(read_folder(folder, step=2, mask_border=False))
    assert len(frames) == 2
    assert frames[0].right is None and frames[0].baseline is None and frames[0].depth is None
    assert frames[0].mask.all()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("calibration.yaml", None, "calibration.yaml: file is missing"),
        ("calibration.yaml", "fx: [", "calibration.yaml: not a readable YAML"),
        ("calibration.yaml", "fx: 1\n", "calibration.yaml: fy must be a positive number, got None"),
        ("calibration.yaml", "fx: -1\n", "calibration.yaml: fx must be a positive number, got -1"),
        ("calibration.yaml", CALIBRATION, "calibration.yaml: baseline_m is missing"),
        ("calibration.yaml", CALIBRATION.replace("160", "320") + "baseline_m: 1\n", "width and height are 320×128"),
        ("right/00051.png", None, "right image of 00051.png is missing"),
        ("left/00001.png", "x", "left/00001.png: not a readable image"),
        ("left/a00001.png", "x", "have the same number"),
    ],
)
def test_damaged_image_folder_is_refused_by_name(folder, name, text, message):
    (folder / name).unlink(missing_ok=True)
    if text is not None:
        (folder / name).write_text(text)
    with pytest.raises(SequenceError, match=message):
        list(read_folder(folder))


# ----------------------------------------------------------------------------------------------------------- videos


@pytest.fixture
def video(tmp_path):
    root = tmp_path / "recording"
    poses = trajectory(8)
    write_video(root / "endo.mp4", (see_plane(K_LEFT, BARREL, pose)[0] for pose in poses.values()), fps=50.0)
    write_poses(root / "poses.txt", {n: poses[n] for n in range(0, 8, 3)})
    return root


INTRINSICS = {"fx": 150.0, "fy": 152.0, "cx": 78.5, "cy": 65.5, "distortion": BARREL.tolist()}


def test_video_with_poses_beside_it(video):
    frames = list(open_sequence(video, **INTRINSICS))
    assert [f.stamp_ns for f in frames] == [1_000_000_000, 1_060_000_000, 1_120_000_000]
    for frame in frames:
        assert frame.right is None and frame.depth is None
        assert_frame_agrees(frame, tolerance=12)


def test_video_pose_scale_and_calibration_file(video):
    (video / "calibration.yaml").write_text("fx: 150\nfy: 152\ncx: 78.5\ncy: 65.5\ndistortion: [-0.2, 0.03]\n")
    frames = list(read_video(video, scale=0.1))
    np.testing.assert_allclose(frames[1].camera.position, 0.1 * trajectory(4)[3][:3, 3], atol=1e-9)


def test_video_mask_for_all_frames_and_per_frame(video):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :80] = 255
    write_rgb(video / "mask.png", mask)
    assert all(f.mask[60, 20] == 255 and f.mask[60, 140] == 0 for f in read_video(video, **INTRINSICS))
    write_rgb(video / "tools/000003.png", mask)
    frames = list(read_video(video, mask=video / "tools", mask_polarity="tool", **INTRINSICS))
    assert [f.mask[60, 20] for f in frames] == [255, 0, 255]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "poses are given .* but no intrinsics; pass fx"),
        ({"fy": 3.0}, "need fx as well"),
        ({"fx": -3.0}, "fx and fy must be positive"),
        ({"fx": 150.0, "step": 0}, "step must be 1 or more"),
        ({"fx": 150.0, "start": 100}, "no frame between start=100"),
        ({"fx": 150.0, "poses": "absent.txt"}, "absent.txt: file is missing"),
        ({"fx": 150.0, "mask": "absent.png"}, "absent.png: file is missing"),
        ({"fx": 150.0, "colour": 1}, "video layout has no option 'colour'"),
    ],
)
def test_wrong_video_options_are_explained(video, options, message):
    with pytest.raises(SequenceError, match=message):
        open_sequence(video, **options)


def test_video_that_ends_early_is_reported(video, caplog):
    source = Video(video / "endo.mp4")
    assert [number for number, _ in source.frames([6, 7, 8, 9])] == [6, 7]
    assert "ends before frame 8; 2 frames are missing" in caplog.text
    with pytest.raises(SequenceError, match="frame 50 cannot be decoded"):
        list(source.frames([50]))


# ---------------------------------------------------------------------------------------------------------- helpers


def test_pose_file_is_xyzw_and_camera_to_world(tmp_path):
    expected = pose_of((0.1, 0.2, 0.3), x=0.3, y=-0.2, z=0.5)
    write_poses(tmp_path / "poses.txt", {7: expected})
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt")[7], expected, atol=1e-9)
    w, x, y, z = matrix_to_quat(expected[:3, :3])
    (tmp_path / "poses.csv").write_text(f"frame,tx,ty,tz,qx,qy,qz,qw\n7,.1,.2,.3,{x},{y},{z},{w}\n")
    np.testing.assert_allclose(read_poses(tmp_path / "poses.csv")[7], expected, atol=1e-9)


def test_numbers_in_file_names(tmp_path):
    for name in ("000012l.png", "000012r.png", "frame-000003.mask.png", "notes.txt", "nothing.png"):
        (tmp_path / name).touch()
    assert numbered_files(tmp_path, ending="l") == {12: tmp_path / "000012l.png"}
    assert numbered_files(tmp_path, ending="mask") == {3: tmp_path / "frame-000003.mask.png"}
    assert numbered_files(tmp_path / "absent") == {}


def test_masks_without_tools_keep_all_tissue(tmp_path):
    assert tool_is_white([np.zeros((4, 4), np.uint8)], tmp_path)
    assert not tool_is_white([np.full((4, 4), 255, np.uint8)], tmp_path)


def test_near_balance_of_mask_colours_is_a_warning(tmp_path, caplog):
    half = np.zeros((4, 4), np.uint8)
    half[:2] = 255
    tool_is_white([half], tmp_path)
    assert "this is close" in caplog.text


def test_vignette_is_dark_and_dark_tissue_is_not():
    images = [np.full((60, 80, 3), 100, np.uint8) for _ in range(2)]
    for image in images:
        image[:, :20] = 2
        image[25:35, 50:60] = 2  # a hole in the tissue
    images[1][10:20, 40:50] = 0
    mask = lit_area(images)
    assert not mask[:, :20].any()
    assert mask[:, 24:].all()


def test_one_bright_image_does_not_hide_the_border():
    rows, columns = np.mgrid[:60, :80]
    picture = np.where(np.hypot(rows - 30, columns - 40) < 28, 120, 2).astype(np.uint8)[..., None].repeat(3, -1)
    np.testing.assert_array_equal(lit_area([picture] * 9 + [np.full_like(picture, 255)]), lit_area([picture]))


def test_edge_of_a_round_picture_may_wander():
    rows, columns = np.mgrid[:120, :160]
    tissue = [np.hypot(rows - 60, columns - 78 - shift) < 50 for shift in (0, 3)]
    images = [np.where(inside, 120, 2).astype(np.uint8)[..., None].repeat(3, -1) for inside in tissue]
    images[0][55:65, 70:90] = images[0][55:65, 31:36] = 2  # a hole, and a dark spot that begins inside
    lit = lit_area(images)
    for image, inside in zip(images, tissue):
        mask = lit_now(lit, image)
        assert not mask[~inside].any()
        assert mask[cv2.erode(np.uint8(inside), np.ones((13, 13))) > 0].all()
    assert lit[~tissue[0]].any()
    whole = np.full_like(lit, 255)
    assert lit_now(whole, images[0]) is whole


def test_unknown_layouts_are_listed(tmp_path):
    with pytest.raises(SequenceError, match="StereoCalibration.ini.*poses_bounds.npy.*left/.*mp4") as error:
        open_sequence(tmp_path)
    assert all(name in str(error.value) for name in READERS)
    with pytest.raises(SequenceError, match="unknown kind 'nerf'; choose auto, stereomis"):
        open_sequence(tmp_path, kind="nerf")
    with pytest.raises(SequenceError, match="no such file or folder"):
        open_sequence(tmp_path / "absent")


# ----------------------------------------------------------------------------------------------- structure from motion


def similarity_error(estimated: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square distance of positions [N, 3] after the best similarity, relative to the path length."""
    a, b = estimated - estimated.mean(0), reference - reference.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ sign) / (a**2).sum()
    error = np.sqrt((((scale * a @ (u @ sign @ vt).T) - b) ** 2).sum(1).mean())
    return error / np.linalg.norm(np.diff(reference, axis=0), axis=1).sum()


def relief_images(poses, K_cv, size=(320, 240)):
    """Views of a bumpy, finely textured surface, ray-marched."""
    rng = np.random.default_rng(3)
    noise = sum(
        cv2.resize(rng.uniform(0, 1, (n, n)).astype(np.float32), (1024, 1024), interpolation=cv2.INTER_CUBIC) / 2**i
        for i, n in enumerate((32, 96, 256))
    )
    noise = cv2.normalize(noise, None, 10, 245, cv2.NORM_MINMAX)
    u, v = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    rays = np.stack([(u - K_cv[0, 2]) / K_cv[0, 0], (v - K_cv[1, 2]) / K_cv[1, 1], np.ones_like(u)], -1)
    for pose in poses:
        turned, origin = rays @ pose[:3, :3].T, pose[:3, 3]
        depth = np.full(u.shape, 0.1)
        for _ in range(30):  # fixed point of a gentle height field
            points = origin + turned * depth[..., None]
            height = 0.1 + 0.012 * np.sin(points[..., 0] / 0.012) * np.cos(points[..., 1] / 0.015)
            depth = (height - origin[2]) / turned[..., 2]
        points = origin + turned * depth[..., None]
        columns = ((points[..., 0] / 0.16 + 0.5) * 1024).astype(np.float32)
        rows = ((points[..., 1] / 0.16 + 0.5) * 1024).astype(np.float32)
        grey = cv2.remap(noise, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        yield np.repeat(grey[..., None], 3, -1).round().astype(np.uint8)


ORBIT = [pose_of((0.05 * np.sin(a), 0.01 * np.cos(3 * a), 0.1 - 0.1 * np.cos(a)), y=-a) for a in np.linspace(-0.35, 0.35, 6)]
K_RELIEF = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])


def test_structure_from_motion_on_stereo_is_metric():
    pytest.importorskip("pycolmap")
    offset = pose_of((BASELINE, 0, 0))
    result = estimate_poses(
        relief_images(ORBIT, K_RELIEF),
        K_RELIEF + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]],
        right_images=relief_images([pose @ offset for pose in ORBIT], K_RELIEF),
        baseline=BASELINE,
        threads=1,
    )
    assert sorted(result.poses) == list(range(6)) and result.metric and not result.distortion
    np.testing.assert_allclose(result.poses[0], np.eye(4), atol=1e-9)
    for number, pose in result.poses.items():
        expected = np.linalg.inv(ORBIT[0]) @ ORBIT[number]
        assert np.linalg.norm(pose[:3, 3] - expected[:3, 3]) < 1e-3
        assert np.abs(pose[:3, :3] - expected[:3, :3]).max() < 0.01


def test_folder_without_poses_is_posed_and_the_guessed_scale_is_announced(tmp_path, caplog):
    pytest.importorskip("pycolmap")
    for number, image in enumerate(relief_images(ORBIT, K_RELIEF)):
        write_rgb(tmp_path / f"left/{number:06d}.png", image)
    (tmp_path / "calibration.yaml").write_text("fx: 300\nfy: 300\ncx: 160\ncy: 120\n")
    recording = read_folder(tmp_path)
    frames = list(recording)
    assert len(frames) == 6
    positions = np.array([frame.camera.position for frame in frames])
    assert similarity_error(positions, np.array([pose[:3, 3] for pose in ORBIT])) < 0.01
    assert "THE SCALE IS A GUESS" in caplog.text
    caplog.clear()
    assert [f.stamp_ns for f in recording] == [f.stamp_ns for f in frames]
    assert "SCALE" not in caplog.text  # estimated once


def test_structure_from_motion_that_fails_says_why(tmp_path):
    pytest.importorskip("pycolmap")
    flat = itertools.repeat(np.full((120, 160, 3), 128, np.uint8), 3)
    with pytest.raises(SequenceError, match="found no pair of images"):
        estimate_poses(flat)
    with pytest.raises(SequenceError, match="needs at least 2 images, got 1"):
        estimate_poses([np.zeros((120, 160, 3), np.uint8)])


@pytest.mark.skipif(not (SHARED / "gallbladder/endo.mp4").is_file(), reason="the gallbladder video is not at ../shared/data")
def test_structure_from_motion_on_a_real_video(tmp_path):
    reference = read_poses(SHARED / "gallbladder/poses.txt")
    video = Video(SHARED / "gallbladder/endo.mp4")
    numbers = list(range(0, 96, 12))
    images = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for _, image in video.frames(numbers)]
    lit = lit_area(images)
    K, distortion = np.array([[453.7, 0, 320], [0, 453.7, 180], [0, 0, 1]]), [-0.083]
    rectification = Rectification.mono(K, distortion, (640, 360))
    masks = [rectification.mask(lit)] * len(images)
    result = estimate_poses((rectification.left(i) for i in images), rectification.K, masks=masks, scale=0.01)
    assert len(result.poses) >= len(numbers) - 1
    assert result.reprojection_error < 2.0
    placed = sorted(result.poses)
    estimated = np.array([result.poses[n][:3, 3] for n in placed])
    # Loose: the tissue moves and the camera hardly does, so a few frames of one eye leave the relief open.
    assert similarity_error(estimated, np.array([reference[numbers[n]][:3, 3] for n in placed])) < 0.25


@pytest.mark.skipif(not (SHARED / "hamlyn06/left").is_dir(), reason="the hamlyn06 recording is not at ../shared/data")
def test_structure_from_motion_on_real_stereo_is_metric(tmp_path):
    source = SHARED / "hamlyn06"
    for name in ("left", "right", "calibration.yaml"):
        (tmp_path / name).symlink_to(source / name)
    reference = [frame.camera.position for frame in read_folder(source, stop=400, step=2)]
    estimated = [frame.camera.position for frame in read_folder(tmp_path, stop=400, step=2)]
    assert len(estimated) == len(reference) == 4
    assert similarity_error(np.array(estimated), np.array(reference)) < 0.02
    travel = [np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() for positions in (estimated, reference)]
    assert travel[0] == pytest.approx(travel[1], rel=0.08)  # the reference's own scale is good to 3 %
