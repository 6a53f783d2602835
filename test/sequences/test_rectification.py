"""Rectification, on a known plane."""

import numpy as np
import pytest
from plane_scene import (
    BARREL,
    BASELINE,
    HEIGHT,
    K_LEFT,
    K_RIGHT,
    NO_DISTORTION,
    WIDTH,
    assert_frame_agrees,
    pose_of,
    right_pose,
    rotation,
    see_plane,
)

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.rectification import Rectification, StereoCalibration


@pytest.mark.slow
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


def test_a_principal_point_outside_the_images_is_refused():
    K = intrinsic_matrix(150, 150, 80, HEIGHT + 1)
    with pytest.raises(SequenceError, match=rf"calibration: K_right: the principal point \(80, {HEIGHT + 1}\) lies outside the images"):
        StereoCalibration("calibration", (WIDTH, HEIGHT), K_LEFT, BARREL, K, BARREL, np.eye(3), np.array([-BASELINE, 0, 0]))


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


TURNS_BACK = np.array([-0.09, 0.94, 0, 0, -2.0])  # at 0.65 focal lengths from the middle


@pytest.mark.parametrize("eye", ["one", "left", "right"])
def test_nothing_is_seen_where_a_distortion_turns_back(eye, caplog):
    caplog.set_level("INFO")
    K, size = np.array([[100.0, 0, 80], [0, 100, 64], [0, 0, 1]]), (160, 128)
    if eye == "one":
        rectification = Rectification.mono(K, TURNS_BACK, size, f"turns back, {eye}")
    else:
        D = [TURNS_BACK if eye == this else NO_DISTORTION for this in ("left", "right")]
        calibration = StereoCalibration(f"turns back, {eye}", size, K, D[0], K, D[1], np.eye(3), np.array([-BASELINE, 0, 0]))
        rectification = Rectification.stereo(calibration)
    rows, columns = np.mgrid[1:129, 1:161]
    raw = np.dstack([rows, columns, rows]).astype(np.uint8)
    seen = (rectification.right if eye == "right" else rectification.left)(raw)
    row = seen[64, 80:, 1].astype(int)
    assert (np.diff(row[row > 0]) >= 0).all() and row[60] > 0
    assert (seen[0, 0] == 0).all()
    if eye != "right":
        assert not rectification.valid[seen.max(-1) == 0].any() and not rectification.valid[0, 0]
    assert f"turns back, {eye}" in caplog.text and "of the frame is left out; if that is tissue" in caplog.text


def test_mono_undistortion_shows_what_its_pinhole_says():
    rectification = Rectification.mono(K_LEFT + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], BARREL, (WIDTH, HEIGHT))
    pose = pose_of((0.002, 0.001, 0), y=0.1)
    image, points = see_plane(K_LEFT, BARREL, pose)
    camera = Camera(rectification.K, WIDTH, HEIGHT, rectification.pose(pose))
    frame = Frame(1, rectification.left(image), camera, depth=rectification.depth(points), mask=rectification.valid)
    assert_frame_agrees(frame)


@pytest.mark.parametrize("distortion", [[5] * 5, [np.inf], [1e300], [0.1, 0, 0, 0, 0, 0]])
def test_distortion_of_no_lens_is_refused_by_name(distortion):
    shown = ", ".join(f"{value:g}" for value in distortion).replace("+", r"\+")
    with pytest.raises(SequenceError, match=f"endo.mp4: distortion {shown} is that of no lens; give k1"):
        Rectification.mono(K_LEFT, distortion, (WIDTH, HEIGHT), "endo.mp4")


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
