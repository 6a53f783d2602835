"""Views with wrong poses, without baseline, or with instruments."""

import dataclasses

import cv2
import numpy as np
import pytest
from short_training import bare, finite, options
from trained import trainer_of

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.reconstruction.dynamic_mask import without_motion
from endo_sim_ros.reconstruction.priors.sources import right_view
from endo_sim_ros.reconstruction.triangulation import match_features, misposed
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence


@pytest.fixture(scope="module")
def large():
    """Five frames 480×384."""
    return list(phantom_sequence(PhantomConfig(width=480, height=384, frames=5, travel=0.02, stereo=False)))


def test_the_right_image_is_a_view_of_the_same_scene(views):
    frame = views[4]
    right = right_view(frame)
    model = trainer_of(views, options(iterations=40, max_gaussians=8000, extrapolation=0.0, learning_rate=1.0)).run()
    image, _ = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(right.camera)
    wrong, _ = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(frame.camera)
    assert metrics.psnr(image, right.image, right.mask) > metrics.psnr(wrong, right.image, right.mask) + 3


FAULTS = {  # of view 2 of five: a rotation vector of its camera, and a movement along its axes in metres
    "turned": ([0.1, -0.08, 0.0], [0.0, 0.0, 0.0]),
    "rolled": ([0.0, 0.0, 0.1], [0.0, 0.0, 0.0]),
    "moved": ([0.0, 0.0, 0.0], [0.03, 0.02, 0.0]),
    "nearer": ([0.0, 0.0, 0.0], [0.0, 0.0, 0.01]),  # as a zoom would
    "farther": ([0.0, 0.0, 0.0], [0.0, 0.0, -0.01]),
}


def misplaced(frame, fault):
    pose, (rotation, movement) = frame.camera.pose.copy(), FAULTS[fault]
    pose[:3, 3] += pose[:3, :3] @ np.array(movement)
    pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.array(rotation))[0]
    return dataclasses.replace(frame, camera=frame.camera.at(pose))


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_pose_among_good_ones_is_found(large, fault, caplog):
    frames = [bare(frame) for frame in large]
    assert misposed(frames, match_features(frames)) == [] and not caplog.text
    frames[2] = misplaced(frames[2], fault)
    assert misposed(frames, match_features(frames)) == [2]
    if fault == "moved":
        trainer = trainer_of(frames, options(image_width=160, depth="points"))
        assert len(trainer.cameras) == 4 and "left out" in caplog.text


def test_with_stereo_a_wrong_pose_among_three_is_left_out(caplog):
    views = list(phantom_sequence(PhantomConfig(width=320, height=256, frames=3, travel=0.02)))
    views = [dataclasses.replace(view, depth=None) for view in views]
    short = options(image_width=80, iterations=1)
    assert len(trainer_of(views, short).cameras) == 3 and "left out" not in caplog.text
    trainer = trainer_of([views[0], misplaced(views[1], "farther"), views[2]], short)
    assert len(trainer.cameras) == 2 and f"{views[1].stamp_ns * 1e-9:.3f} s left out" in caplog.text
    trainer_of([views[0], misplaced(views[1], "farther")], short)
    assert "the poses of views 0 and 1 contradict" in caplog.text


def test_swapped_poses_of_two_views_are_found(large):
    frames = [bare(frame) for frame in large]
    frames[1], frames[3] = (dataclasses.replace(frames[i], camera=frames[j].camera) for i, j in ((1, 3), (3, 1)))
    assert misposed(frames, match_features(frames)) == [1, 3]


def test_of_two_views_neither_is_left_out(large, caplog):
    for first, second, fault in ((bare(large[0]), bare(large[1]), "turned"), (large[0], large[1], "nearer")):  # the latter takes depth
        frames = [first, misplaced(second, fault)]
        caplog.clear()
        assert misposed(frames, match_features(frames)) == []
        assert "the poses of views 0 and 1 contradict" in caplog.text


def test_pure_rotation_trains_with_depth_and_is_an_error_without(views):
    turned = []
    for frame, angle in ((views[0], 0.0), (views[0], 0.04)):
        pose = frame.camera.pose.copy()
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        H = frame.camera.K @ pose[:3, :3].T @ frame.camera.pose[:3, :3] @ np.linalg.inv(frame.camera.K)
        warp = lambda image, H=H: cv2.warpPerspective(image, H, (160, 128))
        images = {name: warp(getattr(frame, name)) for name in ("image", "mask", "depth")}
        turned.append(dataclasses.replace(frame, right=None, camera=frame.camera.at(pose), **images))
    assert finite(trainer_of(turned, options()).run())
    with pytest.raises(SequenceError, match="scene points could be found in 2 views"):
        trainer_of([bare(frame) for frame in turned], options())


@pytest.mark.parametrize("reason, change", {
    "overexposed": lambda frame: {"image": np.full_like(frame.image, 255)},
    "black": lambda frame: {"image": np.zeros_like(frame.image)},
    "masked": lambda frame: {"mask": np.zeros_like(frame.mask)},
}.items())  # fmt: skip
def test_a_view_that_shows_nothing_is_left_out(views, caplog, reason, change):
    blind = dataclasses.replace(views[4], **change(views[4]))
    trainer = trainer_of([views[0], blind, views[8]], options())
    assert len(trainer.cameras) == 2 and f"left out: {reason}" in caplog.text
    with pytest.raises(SequenceError, match=f"every (view|pixel of every view) is {reason}"):
        trainer_of([blind], options())


def test_an_instrument_in_one_of_several_views_is_left_out(views, caplog):
    frame, tool = views[4], np.zeros((128, 160), np.uint8)
    cv2.line(tool, (60, 100), (110, 50), 1, 14)
    shown = (tool > 0) & (frame.depth > 0)
    image = np.where(shown[..., None], np.uint8(150), frame.image)
    held = dataclasses.replace(frame, image=image, depth=np.where(shown, 0.6 * frame.depth, frame.depth).astype(np.float32))
    still = [views[0], views[2], views[6], views[8]]
    assert all(a is b for a, b in zip(without_motion([*still, frame], 0.05), [*still, frame])) and not caplog.text
    found = without_motion([*still, held], 0.05)
    assert all(a is b for a, b in zip(found[:4], still)) and f"{frame.stamp_ns * 1e-9:.3f} s: " in caplog.text
    hidden = (found[4].mask == 0) & (frame.mask > 0)
    assert hidden[shown].mean() > 0.8 and hidden[~shown].mean() < 0.05
    assert without_motion([views[0], held], 0.05)[1] is held  # nobody can tell which of two is right
    shallow = dataclasses.replace(frame, depth=0.6 * frame.depth)
    assert without_motion([*still, shallow], 0.05)[4] is shallow and "check its depth and pose" in caplog.text
    for choice in (False, True):
        caplog.clear()
        assert finite(trainer_of([*still, held], options(dynamic_mask=choice)).run())
        assert ("something moved" in caplog.text) == choice
