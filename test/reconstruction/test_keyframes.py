"""Keyframes that spread, and frames that shrink."""

import dataclasses

import numpy as np

from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction import ReconstructionConfig, ScenePoints, choose_views, select_keyframes, shrink
from endo_sim_ros.reconstruction.stage_configs import CoverageConfig


def blank(pose, size=(32, 24), **changes):
    width, height = size
    K = np.array([[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]])
    image = np.full((height, width, 3), 90, np.uint8)
    return Frame(1, image, Camera(K, width, height, pose), **changes)


def at(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def test_keyframes_hold_the_ends_and_spread():
    frames = [blank(at(x)) for x in (0, 0.001, 0.002, 0.05, 0.051, 0.1)]
    assert select_keyframes(frames, 2) == [0, 5]
    assert select_keyframes(frames, 3) == [0, 3, 5]
    assert select_keyframes(frames, 1) == [0]
    assert select_keyframes(frames, 99) == list(range(6))
    assert select_keyframes([], 3) == []


def test_keyframes_spread_over_rotations_too():
    frames = [blank(look_at(np.zeros(3), np.array([x, 0.0, 0.1]))) for x in (0, 0.001, 0.05, 0.1)]
    assert select_keyframes(frames, 3) == [0, 2, 3]


def test_keyframes_of_identical_poses_are_different_frames():
    assert len(set(select_keyframes([blank(np.eye(4))] * 5, 3))) == 3


def flight(length, count=300):
    """Glances of a camera, a picture of 10 cm wide at 9.4 cm, that moves sideways."""
    return [blank(at(x)) for x in np.linspace(0, length, count)]


def test_a_camera_that_hardly_moves_has_eight_keyframes_and_a_flight_as_many_as_it_is_long(caplog):
    assert len(select_keyframes(flight(0.001))) == 8
    assert len(select_keyframes(flight(0.001, 5))) == 5
    caplog.set_level("INFO")
    far, farther = (len(select_keyframes(flight(length))) for length in (0.1, 0.2))
    assert 0.1 / (2 * 0.02 * 0.1067) <= far <= 0.1 / (0.015 * 0.1067)  # views are a third of a millimetre apart
    assert 1.3 * far < farther <= 200
    assert len(select_keyframes(flight(3.0))) == 200
    assert "keyframes of 300 views, enough" in caplog.text and "as many as coverage.max_keyframes allows" in caplog.text
    assert len(select_keyframes(flight(0.3), 8)) == 8
    assert "8 keyframes of 300 views, as many as keyframes allows: up to 3" in caplog.text


def test_no_view_is_farther_from_a_keyframe_than_the_share_that_may_be_new():
    frames, options = flight(0.3), CoverageConfig(new_share=0.1)
    chosen = select_keyframes(frames, options=options)
    x = np.linspace(0, 0.3, 300)
    assert np.abs(x[:, None] - x[chosen]).min(1).max() <= 0.1 * 0.1 * 32 / 30
    assert chosen == select_keyframes(frames, options=options)


def test_the_nearer_the_tissue_the_more_keyframes():
    """Scene points tell how far away it is."""
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.4, 60), np.linspace(-0.02, 0.02, 9)), -1).reshape(-1, 2)
    points = lambda z: ScenePoints(np.column_stack([grid, np.full(len(grid), z)]), np.zeros((len(grid), 3)))
    near, far = (len(select_keyframes(flight(0.3), points=points(z))) for z in (0.05, 0.2))
    assert near > 2 * far


def test_turning_and_going_nearer_need_keyframes_too():
    turning = [blank(look_at(np.zeros(3), np.array([x, 0.0, 0.1]))) for x in np.linspace(-0.05, 0.05, 100)]
    ahead = []
    for z in np.linspace(0, 0.05, 100):
        pose = np.eye(4)
        pose[2, 3] = z
        ahead.append(blank(pose))
    assert len(select_keyframes(turning)) > 12 and len(select_keyframes(ahead)) > 12


def test_views_are_chosen_by_coverage_with_points_of_the_sample():
    frames = flight(0.002, 20)
    chosen, points = choose_views(frames, frames[::5], ReconstructionConfig())
    assert len(chosen) == 8 and points is not None
    assert choose_views(frames[:8], [], ReconstructionConfig()) == (list(range(8)), None)
    assert len(choose_views(frames, frames[::5], ReconstructionConfig(keyframes=3))[0]) == 3


def test_shrinking_keeps_pixels_and_intrinsics_together():
    """A ramp of depth and colour stays, to half a pixel of the larger image, what the shrunken camera expects."""
    height, width = 90, 120
    v, u = np.mgrid[:height, :width] + 0.5
    image = np.stack([u, v, u], -1).astype(np.uint8)
    frame = blank(np.eye(4), (width, height), depth=(u + 1000 * v).astype(np.float32))
    frame = shrink(dataclasses.replace(frame, image=image, right=image, right_K=frame.camera.K), 40)
    camera = frame.camera
    assert (camera.width, camera.height, *frame.image.shape) == (40, 30, 30, 40, 3)
    np.testing.assert_allclose(frame.right_K, camera.K)
    assert camera.K[0, 0] == 10
    assert camera.K[0, 2] == 20
    rows, columns = np.mgrid[:30, :40]
    np.testing.assert_allclose(frame.depth, (columns + 0.5) * 3 + 1000 * (rows + 0.5) * 3)  # centre of 3 × 3 pixels
    np.testing.assert_allclose(frame.image[..., 0], columns * 3 + 1)


def test_a_shrunken_pixel_is_tissue_only_if_all_of_it_is():
    mask = np.full((24, 32), 255, np.uint8)
    mask[:, :3] = 0
    small = shrink(blank(np.eye(4), mask=mask), 16)
    assert (small.mask[:, :2] == 0).all()
    assert (small.mask[:, 2:] == 255).all()


def test_narrow_frames_are_left_alone():
    frame = blank(np.eye(4))
    assert shrink(frame, 32) is frame
