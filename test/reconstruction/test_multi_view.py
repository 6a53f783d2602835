"""Depth refined by the right image, other views and scene points."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from peak_memory import peak_of
from short_training import NO_POINTS, bare, options
from thorough import mostly_thorough
from training_views import unknown, with_prior

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.kernels import launch
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion
from endo_sim_ros.reconstruction import prepare
from endo_sim_ros.reconstruction.priors import smoothing_kernels
from endo_sim_ros.reconstruction.priors.inverse_depth import correct, smooth
from endo_sim_ros.reconstruction.priors.multi_view import refine_depth
from endo_sim_ros.reconstruction.priors.sources import estimate_depth
from endo_sim_ros.reconstruction.priors.stereo import disparity_offsets
from endo_sim_ros.reconstruction.scene import ScenePoints, TrainingView, shrink


def matched(frames):
    """Views whose prior is from stereo matching."""
    return estimate_depth(unknown(frames), NO_POINTS, options(depth="stereo"))


def plain_pair(frame):
    return frame


def dark_right(frame):
    return dataclasses.replace(frame, right=frame.right // 2)


def behind_a_tool(frame):
    mask = np.full(frame.image.shape[:2], 255, np.uint8)
    mask[200:300, 240:400] = 0
    return dataclasses.replace(frame, mask=mask)


def with_eyes_that_converge(frame):
    K = frame.camera.K.copy()
    K[0, 2] -= 12  # and the right image with it
    moved = frame.right[:, np.clip(np.arange(frame.camera.width) + 12, 0, frame.camera.width - 1)]
    return dataclasses.replace(frame, right=moved, right_K=K)


@pytest.mark.slow
@pytest.mark.parametrize("pair", mostly_thorough([behind_a_tool, with_eyes_that_converge, plain_pair, dark_right], 2))
def test_flow_between_the_eyes_corrects_what_matching_left(large, pair):
    (prior,) = matched([pair(large[0])])
    (corrected,) = refine_depth([prior], NO_POINTS, "stereo")
    error = lambda view: np.abs(view.depth_prior - large[0].depth)[(prior.depth_prior > 0) & (view.depth_prior > 0)]
    assert np.median(error(corrected)) < 0.6 * np.median(error(prior))
    assert np.sqrt((error(corrected) ** 2).mean()) < 0.8 * np.sqrt((error(prior) ** 2).mean())


@pytest.mark.thorough
@pytest.mark.slow
def test_flow_is_found_in_finer_pixels_than_are_trained_on(large):
    (wide,) = prepare([dataclasses.replace(large[0], depth=None)], options(image_width=320)).views
    (narrow,) = refine_depth([shrink(view, 320) for view in matched(large[:1])], NO_POINTS, "stereo")
    exact = shrink(large[0], 320).depth
    error = lambda view: np.sqrt((((view.depth_prior - exact)[(wide.depth_prior > 0) & (narrow.depth_prior > 0)]) ** 2).mean())
    assert error(wide) < 0.95 * error(narrow)


@pytest.mark.slow
def test_views_come_back_as_narrow_as_asked_for(small):
    views = matched(small[:2])
    shrunk, alone = refine_depth(iter(views), NO_POINTS, "stereo", width=80), refine_depth(views, NO_POINTS, "stereo")
    for view, full in zip(shrunk, alone):
        assert view.image.shape == (64, 80, 3) and full.image.shape == (128, 160, 3)
        assert view.right is full.right is None, "nothing needs them any more"
        np.testing.assert_array_equal(view.depth_prior, shrink(full, 80).depth_prior)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("source", ["stereo", "network"])
def test_a_view_more_takes_no_more_memory_than_the_view_itself(small, monkeypatch, source):
    monkeypatch.setenv("ENDO_SIM_THREADS", "1")  # each thread has arrays of its own

    def copies(count):
        for frame in small[:count]:
            image, right = frame.image.copy(), frame.right.copy() if source == "stereo" else None
            yield dataclasses.replace(TrainingView.of(frame), image=image, right=right, depth=None, depth_prior=frame.depth.copy())

    peak = lambda count: peak_of(lambda: refine_depth(copies(count), NO_POINTS, source, width=40))
    peak(5)  # what is made once
    held = sum(array.nbytes for array in vars(next(copies(1))).values() if isinstance(array, np.ndarray)) / 1e6
    assert peak(9) - peak(5) < 1.05 * 4 * held


@pytest.mark.thorough
@pytest.mark.slow
def test_reflections_of_the_light_do_not_spoil_the_depth_that_views_agree_on(large):
    """A reflection is seen where the tissue is not: through another view's depth it lies beside where that view has it."""
    frames = matched(large[:2])
    centres = np.array([(x, y) for x in range(160, 500, 80) for y in range(120, 420, 80)])
    lit, around = list(frames), np.zeros((512, 640), np.uint8)
    for i, (frame, aside) in enumerate(zip(frames, ((0, 0), (10, 6)))):
        image = frame.image.copy()
        uv, _ = frame.camera.project(frames[0].camera.backproject(large[0].depth)[centres[:, 1], centres[:, 0]])
        for place in uv + aside:
            cv2.circle(image, tuple(int(c) for c in place), 7, (255, 255, 255), -1)
        lit[i] = dataclasses.replace(frame, image=image)
    for x, y in centres:
        cv2.circle(around, (int(x), int(y)), 25, 1, -1)
    where = (around > 0) & (frames[0].depth_prior > 0)
    error = lambda views: np.sqrt(((refine_depth(views, NO_POINTS, "network")[0].depth_prior - large[0].depth)[where] ** 2).mean())
    assert error(lit) < 1.6 * error(frames)


@pytest.mark.slow
def test_pale_tissue_is_no_reflection(large):
    pale = [dataclasses.replace(frame, image=(180 + frame.image // 4).astype(np.uint8)) for frame in large[:2]]
    off = [dataclasses.replace(frame, depth=frame.depth * np.float32(1.03), right=None, baseline=None) for frame in pale]
    corrected = refine_depth(with_prior(off), NO_POINTS, "network")
    assert all(np.median(np.abs(a.depth_prior / b.depth - 1)) < 0.012 for a, b in zip(corrected, large))


@pytest.mark.slow
def test_views_correct_each_others_depth(large):
    frames = large[:2]
    views = matched(frames)
    corrected = refine_depth(views, NO_POINTS, "stereo")
    errors = lambda views: [np.abs(view.depth_prior - exact.depth)[view.depth_prior > 0] for view, exact in zip(views, frames)]
    assert np.median(np.concatenate(errors(corrected))) < 0.5 * np.median(np.concatenate(errors(views)))
    assert all(((a.depth_prior > 0) == (b.depth_prior > 0)).mean() > 0.999 for a, b in zip(corrected, views))


@pytest.mark.thorough
@pytest.mark.slow
def test_depth_between_points_is_believed_more_than_a_guess(large):
    off = with_prior(dataclasses.replace(frame, depth=frame.depth * np.float32(1.03)) for frame in large[:2])
    moved = lambda source: np.abs(refine_depth(off, NO_POINTS, source)[0].depth_prior - off[0].depth_prior).mean()
    assert moved("points") < moved("network")


@pytest.mark.slow
def test_what_the_other_view_hides_stays_where_it_was():
    """Far tissue beside near tissue, which hides a strip of it from a second camera 5 mm to the right; depths are exact."""
    noise = np.random.default_rng(0).integers(0, 256, (2, 512, 700, 3)).astype(np.float32)
    far, near = (np.uint8(np.clip(128 + 6 * (cv2.GaussianBlur(n, (0, 0), 3) - 127.5), 0, 255)) for n in noise)
    K, views = np.array([[500.0, 0, 320], [0, 500, 256], [0, 0, 1]]), []
    for i in range(2):  # the far is 100 mm away and moves by 25 pixels, the near 62.5 mm and 40
        image, depth = far[:, 25 * i : 25 * i + 640].copy(), np.full((512, 640), 0.1, np.float32)
        image[150:350, 240 - 40 * i : 400 - 40 * i], depth[150:350, 240 - 40 * i : 400 - 40 * i] = near[150:350, 240:400], 0.0625
        pose = np.eye(4)
        pose[0, 3] = 0.005 * i
        views.append(Frame(image=image, camera=Camera(K, 640, 512, pose), stamp_ns=i, depth=depth))
    corrected, _ = refine_depth(with_prior(views), NO_POINTS, "network")
    hidden = (corrected.depth_prior - views[0].depth)[150:350, 225:240]
    assert np.sqrt((hidden**2).mean()) < 0.0025  # twice as much where flow is believed that does not lead back


@pytest.mark.parametrize("kept", [np.s_[:6], np.s_[:, :9]])
def test_images_too_small_for_optical_flow_keep_their_depth(small, kept):
    cut = lambda array: np.ascontiguousarray(array[kept])
    views = []
    for frame in small[:2]:
        image, depth = cut(frame.image), cut(frame.depth)
        camera = dataclasses.replace(frame.camera, height=image.shape[0], width=image.shape[1])
        views.append(dataclasses.replace(bare(frame), image=image, depth=depth, mask=None, camera=camera))
    corrected = refine_depth(with_prior(views), NO_POINTS, "network")
    assert all(np.abs(a.depth_prior / b.depth - 1).max() < 0.02 for a, b in zip(corrected, views))


def test_no_pixel_is_corrected_to_another_surface():
    inverse, weight = np.full((64, 80), 10, np.float32), np.zeros((64, 80), np.float32)
    weight[20:40, 20:40] = 1e6
    corrected = correct(inverse, 9 * weight, weight, np.full_like(inverse, 0.1), reach=12, limit=0.25)
    assert 12 < corrected.max() < 12.6 and corrected.min() > 9.9


@pytest.mark.slow
def test_ripples_of_wide_images_are_smoothed_and_edges_are_not():
    width, noise = 1920, np.random.default_rng(0).normal(0, 0.1, (160, 1920))
    step = np.where(np.arange(width) < 960, 8.0, 12.0) + np.zeros_like(noise)
    error = smooth((step + noise).astype(np.float32), 10, 0.05) - step
    assert error.std() < 0.1 * noise.std()
    assert np.abs(error[:, 950:970]).max() < 0.5 * noise.std()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("height, width, size", [(60, 90, 30), (64, 80, 80), (40, 1300, 13), (2, 50, 60)])
def test_the_filter_of_gpus_is_that_of_opencv(height, width, size, device):
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    rng = np.random.default_rng(0)
    inverse = (np.where(np.arange(width) < width / 3, 8.0, 12.0) + rng.normal(0, 0.3, (height, width))).astype(np.float32)
    median, spread = np.float32(np.median(inverse)), size * width / 640
    stride = max(round(spread / 8), 1)
    relative, found = torch.from_numpy(inverse / median).to(device), torch.empty(inverse.shape, device=device)
    arguments = [relative, 0.1, spread / stride, max(round(1.5 * spread / stride), 1), stride, found]
    launch(smoothing_kernels.bilateral, inverse.size, arguments, device)
    np.testing.assert_allclose(median * found.cpu().numpy(), smooth(inverse, size, 0.1), rtol=2e-4)
    if device != "cpu":
        np.testing.assert_allclose(smooth(inverse, size, 0.1, device), smooth(inverse, size, 0.1), rtol=2e-4)


def test_larger_relative_steps_than_an_edge_are_kept():
    step = np.where(np.arange(640) < 320, 10.0, 10.4) + np.zeros((64, 640))
    off = [np.abs(smooth(step.astype(np.float32), 10, edge) - step)[:, 310:330].max() for edge in (0.1, 0.03, 0.02)]
    assert off[0] > 0.15 and off[0] > off[1] > off[2] and off[2] < 0.07


@pytest.mark.slow
def test_scene_points_correct_the_depth_around_them(large):
    frame = large[0]
    off = with_prior([dataclasses.replace(frame, depth=frame.depth * np.float32(1.04), right=None, baseline=None)])
    v, u = np.mgrid[8:512:16, 8:640:16].reshape(2, -1)
    positions = frame.camera.backproject(frame.depth)[v, u]
    (corrected,) = refine_depth(off, ScenePoints(positions, np.zeros_like(positions), 0.002), "network")
    assert np.median(np.abs(corrected.depth_prior / frame.depth - 1)) < 0.01


@pytest.mark.thorough
@pytest.mark.slow
def test_wrong_scene_points_among_good_ones_hardly_move_what_matching_knows(large):
    (prior,) = matched(large[:1])
    v, u = np.mgrid[8:512:16, 8:640:16].reshape(2, -1)
    wrong = np.arange(len(u)) % 10 == 0  # 15 % too far, and as sure of themselves as all
    positions = large[0].camera.backproject(large[0].depth * np.float32(1.15))[v, u]
    good = large[0].camera.backproject(large[0].depth)[v, u]

    def error(positions):
        (corrected,) = refine_depth([prior], ScenePoints(positions, np.zeros_like(positions), 0.003), "stereo")
        return np.sqrt(((corrected.depth_prior - large[0].depth)[prior.depth_prior > 0] ** 2).mean())

    assert error(good[~wrong]) < error(np.where(wrong[:, None], positions, good)) < 2.5 * error(good[~wrong])


@pytest.mark.slow
def test_tissue_that_moves_as_one_tells_what_cameras_that_move_the_other_way_do(small):
    """Flow between views, offsets of pairs and scene points, of tissue where it is at each time."""
    way = np.array([[0.004, -0.002, 0.003], [0.001, 0.003, -0.002]])  # m
    points = np.stack([*np.meshgrid(*[np.linspace(-0.1, 0.1, 9)] * 2), np.full((9, 9), 0.12)], -1).reshape(-1, 3)
    motion = TissueMotion(0.0, points, (PeriodicMotion("breathing", 4.0, 1.0, 9.0, way, np.ones(len(points))),))
    still = [dataclasses.replace(view, stamp_ns=i * 10**9 + 4 * 10**8) for i, view in enumerate(matched(small[:3]))]

    def breathing(view):
        pose = view.camera.pose.copy()
        pose[:3, 3] += motion.paths(view.stamp_ns)[0]
        return dataclasses.replace(view, camera=view.camera.at(pose))

    seen = still[0].camera.backproject(small[0].depth)[::12, ::12].reshape(-1, 3)
    known = ScenePoints.recorded(seen, np.full(seen.shape, 0.5))
    truth = [view.depth_prior for view in refine_depth(still, known, "stereo")]
    with_motion, without = (
        [view.depth_prior for view in refine_depth(map(breathing, still), known, "stereo", motion=each)] for each in (motion, None)
    )
    for depth, there, wrong in zip(truth, with_motion, without):
        np.testing.assert_array_equal(there > 0, depth > 0)
        assert np.quantile(np.abs(there - depth), 0.99) < 2e-5 < np.quantile(np.abs(wrong - depth), 0.5)
    offset = lambda motion: disparity_offsets(
        [breathing(view) for view in still],
        [view.camera.K[0, 0] * view.baseline / view.depth_prior.clip(0.05) + 2 for view in still],
        known,
        motion=motion,
    )
    np.testing.assert_allclose(offset(motion), -2, atol=0.3)
