"""Calibrations that ROS and OpenCV wrote, beside images of a folder and a video."""

import cv2
import numpy as np
import pytest
import stereomis_copy
import yaml
from plane_scene import (
    BARREL,
    HEIGHT,
    K_LEFT,
    K_RIGHT,
    R_EYES,
    T_EYES,
    WIDTH,
    assert_frame_agrees,
    see_plane,
    stereo_images,
    trajectory,
    write_poses,
    write_rgb,
    write_video,
)
from stereomis_copy import preprocessed, preprocessing, raw_frame

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.folder import read_folder
from endo_sim_ros.sequences.opencv_calibrations import find_calibration, read_cameras, read_one
from endo_sim_ros.sequences.readers import open_sequence
from endo_sim_ros.sequences.video import read_video

SIZE = WIDTH, HEIGHT
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def write_opencv(path, **values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()


def write_ros(path, size, K, D, R, P):
    """As camera_calibration does."""
    model = "plumb_bob" if len(D) == 5 else "rational_polynomial"
    lines = [f"image_width: {size[0]}", f"image_height: {size[1]}", f"camera_name: narrow_stereo/{path.stem}", f"distortion_model: {model}"]
    names = ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix")
    for name, value in zip(names, (K, D, R, P), strict=True):
        rows, cols = np.atleast_2d(value).shape
        rounded = ",\n    ".join(", ".join(f"{number:.8f}" for number in row) for row in np.atleast_2d(value))
        lines += [f"{name}:", f"  rows: {rows}", f"  cols: {cols}", f"  data: [{rounded}]"]
    path.write_text("\n".join(lines) + "\n")


def write_ros_pair(root, size=SIZE, K=(K_LEFT, K_RIGHT), D=BARREL, R=R_EYES, T=T_EYES):
    R1, R2, P1, P2, *_ = cv2.stereoRectify(K[0], D, K[1], D, size, R, T[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
    write_ros(root / "left.yaml", size, K[0], D, R1, P1)
    write_ros(root / "right.yaml", size, K[1], D, R2, P2)
    return P1


def write_both_files_of_opencv(root):
    write_opencv(root / "intrinsics.yml", M1=K_LEFT, D1=BARREL[None], M2=K_RIGHT, D2=BARREL[None], corners=np.zeros((20, 54, 2)))
    write_opencv(root / "extrinsics.yml", R=R_EYES, T=1000 * T_EYES[:, None], F=np.eye(3))


def write_vectors_of_cpp(root):
    """As C++ writes std::vector and cv::Vec3d."""
    write_opencv(root / "stereo.yml", K1=K_LEFT, K2=K_RIGHT, R=R_EYES)
    vectors = (f"{name}: [ {', '.join(map(str, values.tolist()))} ]\n" for name, values in (("D1", BARREL), ("D2", BARREL), ("T", T_EYES)))
    (root / "stereo.yml").write_text((root / "stereo.yml").read_text() + "".join(vectors))


def write_files_of_eyes(root):
    for eye, K in (("left", K_LEFT), ("right", K_RIGHT)):
        write_opencv(root / f"{eye}.xml", image_width=WIDTH, image_height=HEIGHT, camera_matrix=K, distortion_coefficients=BARREL[:, None])
    write_opencv(root / "between.xml", R=R_EYES, T=T_EYES[:, None])


FORMS = {
    "ROS": write_ros_pair,
    "ROS, millimetres": lambda root: write_ros_pair(root, T=1000 * T_EYES),
    "OpenCV": lambda root: write_opencv(root / "stereo.xml", K1=K_LEFT, D1=BARREL, K2=K_RIGHT, D2=BARREL, R=R_EYES, T=T_EYES),
    "OpenCV, by our name": lambda root: write_opencv(
        root / "calibration.yaml", cameraMatrix1=K_LEFT, distCoeffs1=BARREL, cameraMatrix2=K_RIGHT, distCoeffs2=BARREL, R=R_EYES, T=T_EYES
    ),
    "OpenCV, two files, millimetres": write_both_files_of_opencv,
    "OpenCV, a file for each eye": write_files_of_eyes,
    "OpenCV, vectors of C++": write_vectors_of_cpp,
}


@pytest.fixture
def raw(tmp_path):
    """A folder of raw pairs, without a calibration."""
    poses = trajectory(3)
    for number, (left, right) in enumerate(stereo_images(poses)):
        write_rgb(tmp_path / f"left/{number:03d}.png", left)
        write_rgb(tmp_path / f"right/{number:03d}.png", right)
        depth = see_plane(K_LEFT, BARREL, poses[number])[1][..., 2]
        write_rgb(tmp_path / f"depth/{number:03d}.png", (1e5 * depth).round().astype(np.uint16))
    write_poses(tmp_path / "poses_left.txt", poses)
    return tmp_path


@pytest.mark.parametrize("form", FORMS)
def test_raw_pairs_are_rectified_by_what_ros_and_opencv_wrote(raw, form):
    FORMS[form](raw)
    cameras = read_cameras(find_calibration(raw))
    assert cameras is not None
    calibration = cameras.raw_pair(SIZE)
    for name, value in (("K_left", K_LEFT), ("K_right", K_RIGHT), ("D_right", BARREL), ("R", R_EYES), ("T", T_EYES)):
        np.testing.assert_allclose(getattr(calibration, name), value, atol=1e-6)
    frames = list(open_sequence(raw, depth_scale=1e-5))
    assert len(frames) == 3
    for frame in frames:
        assert frame.depth is not None and frame.baseline == pytest.approx(np.linalg.norm(T_EYES), rel=1e-4)
        assert_frame_agrees(frame)


def test_one_eye_takes_its_camera(raw):
    projection = write_ros_pair(raw)
    for file in [*(raw / "right").iterdir(), *(raw / "depth").iterdir()]:
        file.unlink()
    for frame in read_folder(raw):
        assert frame.right is None
        assert_frame_agrees(frame)
    fields = read_one(raw, find_calibration(raw), None)
    assert (fields["cx"], fields["cy"]) == pytest.approx((K_LEFT[0, 2] + 0.5, K_LEFT[1, 2] + 0.5))
    (straight, *_) = read_folder(raw, frames_rectified=True)
    np.testing.assert_allclose(straight.camera.K, projection[:, :3] + HALF, atol=1e-6)


@pytest.mark.parametrize("form", ["---\n{}", "# mine\n{}", "\ufeff{}"])
def test_yaml_that_opencv_cannot_read_is_read(tmp_path, form):
    file = tmp_path / "ost.yaml"
    write_ros(file, SIZE, K_LEFT, BARREL, np.eye(3), np.c_[K_LEFT, np.zeros(3)])
    block = "camera_matrix:\n  rows: 3\n  cols: 3\n  data:\n" + "".join(f"  - {number:g}\n" for number in K_LEFT.ravel())
    for text in (file.read_text(), block):
        file.write_text(form.format(text))
        np.testing.assert_array_equal(read_cameras([file]).values["K1"], K_LEFT)


def test_a_video_takes_a_calibration_of_ros_beside_it(tmp_path):
    poses = trajectory(3)
    write_video(tmp_path / "endo.mp4", (see_plane(K_LEFT, BARREL, pose)[0] for pose in poses.values()))
    write_poses(tmp_path / "poses.txt", poses)
    write_ros(tmp_path / "ost.yaml", SIZE, K_LEFT, BARREL, np.eye(3), np.c_[0.9 * K_LEFT + 0.1 * np.diag([0, 0, 1]), np.zeros(3)])
    for options in ({}, {"calibration": tmp_path / "ost.yaml"}):
        for frame in open_sequence(tmp_path, **options):
            assert_frame_agrees(frame, tolerance=12)
    (frame, *_) = open_sequence(tmp_path, frames_rectified=True)
    assert frame.camera.K[0, 0] == pytest.approx(0.9 * K_LEFT[0, 0])


def test_a_video_of_both_eyes_is_rectified_by_what_ros_wrote_beside_it(tmp_path):
    poses = trajectory(3)
    write_video(tmp_path / "endo.mp4", map(np.hstack, stereo_images(poses)))
    write_poses(tmp_path / "poses.txt", poses)
    write_ros_pair(tmp_path)
    frames = list(read_video(tmp_path, eyes="left_right"))
    assert len(frames) == 3
    for frame in frames:
        assert frame.right is not None and frame.baseline == pytest.approx(np.linalg.norm(T_EYES), rel=1e-4)
        assert_frame_agrees(frame, tolerance=12)


@pytest.fixture
def rectified(tmp_path):
    """A folder of pairs with features, rectified, and the calibration of the raw ones by ROS."""
    half = np.diag([0.5, 0.5, 1])
    K = half @ stereomis_copy.K_LEFT, half @ stereomis_copy.K_RIGHT
    write_ros_pair(tmp_path, stereomis_copy.SMALL, K, stereomis_copy.BARREL, stereomis_copy.R, stereomis_copy.T)
    for number in range(0, 12, 3):
        for eye, name in enumerate(("left", "right")):
            write_rgb(tmp_path / f"{name}/{number:03d}.png", preprocessed(raw_frame(number)[eye], eye))
    write_poses(tmp_path / "poses_left.txt", {number: stereomis_copy.pose_of_frame(number) for number in range(0, 12, 3)})
    return tmp_path


def test_pairs_that_are_rectified_already_are_told_and_left(rectified, caplog):
    caplog.set_level("INFO")
    frames = list(read_folder(rectified, mask_border=False))
    assert "images are taken for rectified ones (rows of the eyes are 0." in caplog.text
    np.testing.assert_allclose(frames[0].camera.K, preprocessing()[2] + HALF, atol=1e-6)
    assert frames[0].baseline == pytest.approx(np.linalg.norm(stereomis_copy.T), rel=1e-4)
    np.testing.assert_array_equal(frames[0].image, preprocessed(raw_frame(0)[0], 0))
    twice = list(read_folder(rectified, frames_rectified=False))
    assert np.abs(twice[0].image.astype(int) - frames[0].image).mean() > 5
    K, D = np.diag([0.5, 0.5, 1]) @ stereomis_copy.K_LEFT, stereomis_copy.BARREL
    for file in rectified.glob("*.yaml"):
        file.unlink()
    write_opencv(rectified / "pair.yml", K1=K, D1=D, K2=K, D2=D, R=stereomis_copy.R, T=stereomis_copy.T)
    with pytest.raises(
        SequenceError, match="pair.yml: the images are rectified, but P1 and P2, .* are missing; .* frames_rectified=false if"
    ):
        read_folder(rectified, frames_rectified=True)


def test_raw_pairs_whose_eyes_are_exchanged_are_not_taken_for_rectified_ones(tmp_path):
    size = stereomis_copy.WIDTH, stereomis_copy.HEIGHT
    K, D = (stereomis_copy.K_LEFT, stereomis_copy.K_RIGHT), stereomis_copy.BARREL
    write_ros_pair(tmp_path, size, K, D, stereomis_copy.R, stereomis_copy.T)
    for name, image in zip(("right", "left"), raw_frame(0)[:2], strict=True):
        write_rgb(tmp_path / f"{name}/000.png", image)
    write_poses(tmp_path / "poses_left.txt", {0: np.eye(4)})
    with pytest.raises(SequenceError, match="left.yaml, right.yaml: left and right eye are exchanged: rows of features of frame 0 are "):
        list(read_folder(tmp_path))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"T": 10 * T_EYES}, r"pair.yml: T: the two eyes would be 0.05\d* m or 0.05\d* mm apart, as those of no endoscope; give metres"),
        ({"T": np.array([0, 0.005, 0])}, "pair.yml: the eyes are not side by side"),
        ({"R": np.ones((3, 3))}, "pair.yml: R is not a rotation"),
        ({"R": np.eye(2)}, "pair.yml: R must have 9 finite numbers; calibrate the camera"),
        ({"D1": np.zeros(6)}, "pair.yml: D1 must have 0 or 4 or 5 or 8 or 12 or 14 finite numbers"),
        ({"D2": None}, "pair.yml: D2 is missing; a stereo pair needs K1, D1, K2, D2, R and T of OpenCV, or left.yaml and right.yaml"),
        ({"K2": None}, "pair.yml: K2 is missing; a stereo pair needs K1, D1, K2, D2, R and T of OpenCV, or left.yaml and right.yaml"),
        ({"K1": np.diag([2, 2, 1]) @ K_LEFT}, "pair.yml: cx and cy would be the centre of images of 31.×26., but the images are 160×128"),
        ({"image_width": 320, "image_height": 128}, "pair.yml: is for images of 320×128, but the images are 160×128"),
        ({"image_width": 0, "image_height": 128}, "pair.yml: image_width and image_height must be positive"),
    ],
)
def test_a_wrong_calibration_of_opencv_is_told_by_its_name(raw, values, message):
    values = {"K1": K_LEFT, "D1": BARREL, "K2": K_RIGHT, "D2": BARREL, "R": R_EYES, "T": T_EYES} | values
    write_opencv(raw / "pair.yml", **{name: value for name, value in values.items() if value is not None})
    with pytest.raises(SequenceError, match=message):
        read_folder(raw)


def test_eyes_that_no_laparoscope_has_so_close_are_told(raw, caplog):
    write_opencv(raw / "pair.yml", K1=K_LEFT, D1=BARREL, K2=K_RIGHT, D2=BARREL, R=R_EYES, T=T_EYES / 5)  # in squares of 5 mm
    read_folder(raw)
    assert "pair.yml: T: the two eyes would be 1 mm apart, those of laparoscopes are 3 to 6" in caplog.text


def test_one_eye_may_be_the_right_one(raw):
    write_ros_pair(raw)
    assert read_one(raw, [raw / "right.yaml"], None)["cx"] == pytest.approx(K_RIGHT[0, 2] + 0.5)
    (raw / "left.yaml").unlink()
    with pytest.raises(SequenceError, match="right.yaml: K2 is missing; a stereo pair needs .*, or left.yaml and right.yaml of ROS"):
        read_folder(raw)


def test_a_fisheye_lens_of_opencv_is_refused(tmp_path):
    write_opencv(tmp_path / "cam.xml", fisheye_model=0, camera_matrix=K_LEFT, distortion_coefficients=BARREL)
    assert read_one(tmp_path, [tmp_path / "cam.xml"], None)["distortion"] == BARREL.tolist()
    write_opencv(tmp_path / "cam.xml", fisheye_model=1, camera_matrix=K_LEFT, distortion_coefficients=np.zeros(4))
    with pytest.raises(SequenceError, match="cam.xml: distortion of the model fisheye is not read; calibrate with plumb_bob or rational"):
        read_one(tmp_path, [tmp_path / "cam.xml"], None)


def test_a_lens_whose_distortion_is_not_told_is_refused(tmp_path):
    write_opencv(tmp_path / "cam.yml", camera_matrix=K_LEFT, dist_coeff=BARREL)
    with pytest.raises(SequenceError, match="cam.yml: distortion_coefficients, or D1 of a pair, is missing; write zeros if the lens has"):
        read_one(tmp_path, [tmp_path / "cam.yml"], None)
    assert read_one(tmp_path, [tmp_path / "cam.yml"], True)["distortion"] == []
    write_opencv(tmp_path / "cam.yml", camera_matrix=K_LEFT, distortion_coefficients=np.zeros((0, 0)))  # as ROS has it
    assert read_one(tmp_path, [tmp_path / "cam.yml"], None)["distortion"] == []


def test_a_wrong_calibration_of_ros_is_told_by_its_name(raw):
    write_ros_pair(raw)
    text = (raw / "right.yaml").read_text()
    for old, new, message in (
        ("width: 160", "width: 320", "right.yaml: the cameras would have images of 160×128 and 320×128; calibrate both with images of one"),
        ("plumb_bob", "equidistant", "right.yaml: distortion of the model equidistant is not read"),
        ("data: [", "data: [nan, ", "right.yaml: camera_matrix must have 9 finite numbers"),
        ("projection_matrix", "projection", "left.yaml, right.yaml: R is missing"),
        ("rows: 3", "rows: [", "right.yaml: not a readable calibration of ROS or OpenCV"),
    ):
        (raw / "right.yaml").write_text(text.replace(old, new))
        with pytest.raises(SequenceError, match=message):
            read_folder(raw)
    write_ros(raw / "right.yaml", SIZE, K_RIGHT, BARREL, np.eye(3), np.c_[K_RIGHT, np.zeros(3)])
    with pytest.raises(SequenceError, match="projection_matrix of the right eye tells no baseline"):
        read_folder(raw)
    write_ros(raw / "left.yaml", SIZE, K_RIGHT, BARREL, np.eye(3), np.c_[K_RIGHT, [-0.8, 0, 0]])
    with pytest.raises(SequenceError, match="tells no baseline, that of the left one does: exchange the files"):
        read_folder(raw)
    (raw / "right.yaml").rename(raw / "other.yaml")
    with pytest.raises(SequenceError, match="other.yaml: camera_matrix is in left.yaml as well; name files of a pair left and right"):
        read_folder(raw)
    (raw / "calibration.yaml").write_text("fx: 150\nfy: 150\ncx: 80\ncy: 64\nbaseline_m: 0.005\n")
    with pytest.raises(SequenceError, match="calibration.yaml: frames_rectified is for calibrations of ROS and OpenCV; leave it out"):
        read_folder(raw, frames_rectified=True)


def test_lists_that_python_dumps_as_yaml_are_matrices(tmp_path):
    matrices = {"K1": K_LEFT, "D1": BARREL, "K2": K_RIGHT, "D2": BARREL[None], "R": R_EYES, "T": T_EYES[:, None]}
    (tmp_path / "stereo.yaml").write_text(yaml.dump({name: value.tolist() for name, value in matrices.items()}))
    cameras = read_cameras(find_calibration(tmp_path))
    assert cameras is not None
    for name, value in matrices.items():
        assert np.array_equal(cameras.values[name], value.ravel() if name[0] in "DT" else value)
