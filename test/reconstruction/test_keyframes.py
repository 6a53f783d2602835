"""Keyframes that spread, and frames that shrink."""

import dataclasses

import numpy as np

from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction import select_keyframes, shrink


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
