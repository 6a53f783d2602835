"""Algebra of poses and cameras by its axioms."""

import numpy as np
import pytest

from endo_sim_ros.core.cameras import (
    Camera,
    interpolate_pose,
    invert_pose,
    load_cameras,
    look_at,
    make_pose,
    matrix_to_quat,
    quat_to_matrix,
    save_cameras,
    sent_poses,
    slerp,
)

RNG = np.random.default_rng(0)
K = np.array([[500.0, 0, 310], [0, 480, 250], [0, 0, 1]])


def random_pose():
    return make_pose(RNG.normal(size=3), RNG.normal(size=4))


def test_rotations_are_orthogonal_and_quaternions_come_back():
    quats = RNG.normal(size=(100, 4))
    matrices = quat_to_matrix(quats)
    np.testing.assert_allclose(matrices @ np.swapaxes(matrices, 1, 2), np.tile(np.eye(3), (100, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrices), 1)
    for quat, matrix in zip(quats, matrices):
        unit = quat / np.linalg.norm(quat)
        np.testing.assert_allclose(matrix_to_quat(matrix), unit * np.sign(unit[0]), atol=1e-12)


@pytest.mark.parametrize("quat", [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [1e-9, 1, 1, 0]])
def test_half_turns_convert(quat):
    matrix = quat_to_matrix(np.array(quat, float))
    np.testing.assert_allclose(quat_to_matrix(matrix_to_quat(matrix)), matrix, atol=1e-7)


def test_inverse_and_composition():
    pose = random_pose()
    np.testing.assert_allclose(pose @ invert_pose(pose), np.eye(4), atol=1e-12)


def test_slerp_has_constant_speed_and_takes_the_shorter_arc():
    q1, q2 = np.array([1.0, 0, 0, 0]), -np.array([np.cos(0.4), np.sin(0.4), 0, 0])
    for alpha in (0, 0.25, 0.5, 1):
        matrix = quat_to_matrix(slerp(q1, q2, alpha))
        assert np.arctan2(matrix[2, 1], matrix[1, 1]) == pytest.approx(0.8 * alpha)
    np.testing.assert_allclose(slerp(q1, q1, 0.3), q1)


def test_interpolated_pose_meets_both_ends():
    first, second = random_pose(), random_pose()
    np.testing.assert_allclose(interpolate_pose(first, second, 0), first, atol=1e-9)
    np.testing.assert_allclose(interpolate_pose(first, second, 1), second, atol=1e-9)
    middle = interpolate_pose(first, second, 0.5)
    np.testing.assert_allclose(middle[:3, 3], (first[:3, 3] + second[:3, 3]) / 2)


def test_projection_undoes_backprojection():
    camera = Camera(K, 64, 48, random_pose())
    depth = RNG.uniform(0.05, 0.2, (48, 64))
    uv, z = camera.project(camera.backproject(depth).reshape(-1, 3))
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    np.testing.assert_allclose(uv, np.stack([u.ravel(), v.ravel()], 1), atol=1e-8)
    np.testing.assert_allclose(z, depth.ravel())


def test_resized_camera_sees_the_same_field_of_view():
    camera = Camera(K, 640, 512, random_pose())
    point = camera.backproject(np.full((512, 640), 0.1))[100, 300][None]
    small = camera.resized(160, 128)
    np.testing.assert_allclose(small.project(point)[0] * 4, camera.project(point)[0])


def test_look_at_points_the_optical_axis_with_the_picture_upright():
    camera = Camera(K, 640, 512, look_at(np.array([0.1, 0.0, -0.2]), np.zeros(3)))
    uv, z = camera.project(np.array([[0.0, 0, 0], [0, 0.01, 0]]))
    np.testing.assert_allclose(uv[0], K[:2, 2])
    assert z[0] == pytest.approx(np.hypot(0.1, 0.2)) and uv[1, 1] > uv[0, 1]
    assert np.linalg.det(camera.pose[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize(
    "change, sentence",
    [
        ({"K": np.zeros((3, 3))}, "focal lengths must be positive"),
        ({"K": K * np.nan}, "K must be a finite"),
        ({"width": 0}, "image size must be positive"),
        ({"pose": np.full((4, 4), np.inf)}, "pose must be a finite"),
        ({"pose": np.eye(3)}, "4×4"),
    ],
)
def test_unusable_cameras_are_refused(change, sentence):
    with pytest.raises(ValueError, match=sentence):
        Camera(**{"K": K, "width": 640, "height": 480, "pose": np.eye(4), **change})


def test_cameras_survive_a_file(tmp_path):
    cameras = [Camera(K, 640, 512, random_pose()), Camera(K, 64, 48)]
    save_cameras(cameras, tmp_path / "cameras.json")
    for sent, received in zip(cameras, load_cameras(tmp_path / "cameras.json"), strict=True):
        np.testing.assert_array_equal(received.pose, sent.pose)
        np.testing.assert_array_equal(received.K, sent.K)
        assert (received.width, received.height) == (sent.width, sent.height)
    (tmp_path / "cameras.json").write_text('{"K": 1}')
    with pytest.raises(ValueError, match="cameras.json: not a readable list of cameras"):
        load_cameras(tmp_path / "cameras.json")


def test_a_camera_sees_what_lies_in_its_picture_and_before_it():
    camera = Camera(np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]]), 64, 48, np.eye(4))
    points = np.array([[0, 0, 1], [0.31, 0.23, 1], [0.33, 0, 1], [0, -0.25, 1], [0, 0, -1]])
    assert camera.sees(points).tolist() == [True, True, False, False, False]


def test_poses_that_were_sent_are_the_same_one_by_one_and_together():
    """Bit for bit, as a task and those who see it over topics have to agree."""
    rng = np.random.default_rng(0)
    poses = np.stack([make_pose(rng.normal(size=3), rng.normal(size=4)) for _ in range(50)])
    sent = sent_poses(poses)
    for pose, received in zip(poses, sent):
        assert received.tobytes() == make_pose(pose[:3, 3], matrix_to_quat(pose[:3, :3])).tobytes()
    np.testing.assert_allclose(sent, poses, atol=1e-15)
