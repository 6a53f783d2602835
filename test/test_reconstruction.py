"""From sparse views to a model: every part by itself, then short trainings on the phantom."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure
from trained import trainer_of

from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.held_out import reconstruct_and_measure
from endo_sim_ros.reconstruction import ReconstructionConfig, losses, select_keyframes, shrink
from endo_sim_ros.reconstruction.config import McmcConfig
from endo_sim_ros.reconstruction.initialization import initial_model
from endo_sim_ros.reconstruction.optimizer import Adam
from endo_sim_ros.reconstruction.priors.multi_view import _BY_EYES, _IN_THE_END, _MATCHED, _corrected, _smooth, agreed
from endo_sim_ros.reconstruction.priors.sources import disparity_offsets, interpolated_depth, stereo_disparity, with_depth_prior
from endo_sim_ros.reconstruction.strategies import STRATEGIES
from endo_sim_ros.reconstruction.strategies.mcmc import exploration_noise, relocated
from endo_sim_ros.reconstruction.triangulation import ScenePoints, triangulate
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.bag import write_bag
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.splatting import render

NO_POINTS = ScenePoints.none()


def film(width, height, count):
    return tuple(phantom_sequence(PhantomConfig(width=width, height=height, frames=count)))


@pytest.fixture(scope="module")
def small():
    """Nine frames of the phantom, 160×128, with exact depth and stereo."""
    return film(160, 128, 9)


@pytest.fixture(scope="module")
def large():
    """Four frames of the phantom, 640×512, for matching."""
    return film(640, 512, 4)


def options(**changes):
    short = {"iterations": 12, "max_gaussians": 2000, "refine_every": 5, "device": "cpu"}
    return ReconstructionConfig(**(short | changes))


def bare(frame, **changes):
    """The frame without any depth."""
    nothing = {"depth": None, "right": None, "baseline": None, "right_K": None}
    return dataclasses.replace(frame, **(nothing | changes))


def equal(first: GaussianModel, second: GaussianModel) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first.tensors().values(), second.tensors().values()))


def held_out(model, frames):
    """Mean PSNR (dB) and depth error (m) over frames."""
    renderer = DeformableRenderer(model, None, RenderingConfig(device="cpu"))
    rows = []
    for frame in frames:
        image, depth = renderer.render(frame.camera)
        rows.append([metrics.psnr(image, frame.image), metrics.depth_rmse(depth, frame.depth)])
    return np.mean(rows, 0)


# ----------------------------------------------------------------------------------------------- losses


def reference_ssim(x, y):
    """The SSIM map [H, W, 3] in plain torch, zero padding."""
    t = torch.arange(11, dtype=x.dtype) - 5
    g = torch.exp(-(t**2) / 4.5)
    window = torch.outer(g, g)[None, None] / g.sum() ** 2
    blur = lambda a: torch.nn.functional.conv2d(a.permute(2, 0, 1)[:, None], window, padding=5)[:, 0].permute(1, 2, 0)
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 1e-4, 9e-4
    return (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))


@pytest.fixture
def images():
    generator = torch.Generator().manual_seed(0)
    return tuple(torch.rand(37, 29, 3, generator=generator, dtype=torch.float64) for _ in range(3))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 2e-4)])
def test_ssim_and_its_gradient_are_those_of_the_reference(images, dtype, tolerance):
    x, y, v = images
    y = 0.7 * x + 0.3 * y
    ours, exact = x.clone().to(dtype).requires_grad_(), x.clone().requires_grad_()
    value, expected = losses.ssim(ours, y.to(dtype)), reference_ssim(exact, y)
    torch.testing.assert_close(value.double(), expected, atol=tolerance, rtol=0)
    value.backward(v.to(dtype))
    expected.backward(v)
    assert exact.grad.abs().max() > 0.1
    torch.testing.assert_close(ours.grad.double(), exact.grad, atol=10 * tolerance, rtol=0)


def test_ssim_by_kernels_is_the_same(images):
    x, y, v = (image.float() for image in (*images[:2], torch.randn(images[0].shape, generator=torch.Generator().manual_seed(3))))
    ours, expected = x.clone().requires_grad_(), x.clone().requires_grad_()
    values = [function.apply(image, y) for function, image in ((losses._SsimOnGpu, ours), (losses._Ssim, expected))]
    for value in values:
        value.backward(v)
    torch.testing.assert_close(*values, atol=1e-5, rtol=0)
    torch.testing.assert_close(ours.grad, expected.grad, atol=1e-5 * float(expected.grad.abs().max()), rtol=0)


def test_ssim_is_that_of_torchmetrics_away_from_the_border(images):
    x, y = (image.permute(2, 0, 1)[None] for image in images[:2])
    _, full = structural_similarity_index_measure(x, y, data_range=1.0, return_full_image=True)
    ours = losses.ssim(*images[:2])
    torch.testing.assert_close(ours[5:-5, 5:-5], full[0].permute(1, 2, 0)[5:-5, 5:-5], atol=1e-6, rtol=0)


def test_photometric_loss_of_constant_images_by_hand():
    image, target = torch.full((20, 20, 3), 0.5), torch.full((20, 20, 3), 0.3)
    assert float(losses.photometric(image, target, None, 0.0)) == pytest.approx(0.2)
    expected = 0.8 * 0.2 + 0.2 * float(1 - losses.ssim(image, target).mean())
    assert float(losses.photometric(image, target, None, 0.2)) == pytest.approx(expected, rel=1e-5)


def test_masked_pixels_have_no_part_in_the_photometric_loss(images):
    image, target = images[0].float().requires_grad_(), images[1].float()
    mask = torch.zeros(37, 29)
    mask[:, :15] = 1
    loss = losses.photometric(image, target, mask, 0.2)
    loss.backward()
    assert image.grad[:, 15:].abs().max() == 0
    assert image.grad[:, :15].abs().max() > 0
    other = torch.where(mask[..., None] > 0, images[0].float(), 9.0)
    assert float(losses.photometric(other, target, mask, 0.2)) == float(loss.detach())


def test_masked_mean_counts_channels_and_survives_an_empty_mask():
    values = torch.tensor([[[1.0, 3.0], [9.0, 9.0]]])  # [1, 2, 2]
    assert float(losses.masked_mean(values, torch.tensor([[1.0, 0.0]]))) == 2
    assert float(losses.masked_mean(values, torch.zeros(1, 2))) == 0
    with pytest.raises(ValueError, match="do not fit the mask"):
        losses.masked_mean(values, torch.ones(2, 2))


def test_depth_loss_by_hand():
    depth, prior = torch.tensor([[0.10, 0.20, 0.30]]), torch.tensor([[0.13, 0.0, 0.29]])
    alpha = torch.tensor([[0.8, 1.0, 1.0]])
    assert float(losses.depth_l1(depth, prior, None, alpha, 0.0)) == pytest.approx(0.02)
    assert float(losses.depth_l1(depth, prior, torch.tensor([[1.0, 1.0, 0.0]]), alpha, 0.0)) == pytest.approx(0.03)
    # Seen at 0.125 m, and a fifth of it is transparent.
    assert float(losses.depth_l1(depth, prior, None, alpha, 0.5)) == pytest.approx((0.005 + 0.5 * 0.2 * 0.13 + 0.01) / 2)


def test_total_variation_by_hand():
    depth = torch.tensor([[1.0, 2.0, 4.0], [1.0, 1.0, 1.0]])
    # Differences along rows: 1, 2, 0, 0; along columns: 0, 1, 3.
    assert float(losses.total_variation(depth, None)) == pytest.approx(3 / 4 + 4 / 3)
    mask = torch.tensor([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    assert float(losses.total_variation(depth, mask)) == pytest.approx(1 / 3 + 1 / 2)


# -------------------------------------------------------------------------------------------- keyframes


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


# --------------------------------------------------------------------------------- shrinking of frames


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


# ---------------------------------------------------------------------------------------- triangulation


def test_triangulated_points_lie_on_the_surface(large):
    points, colors, error = triangulate(list(large))
    assert len(points) > 300
    assert colors.shape == points.shape
    assert 0 <= colors.min() <= colors.max() <= 1
    off = []
    for frame in large:
        uv, z = frame.camera.project(points)
        u, v = np.floor(uv).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < 640) & (v < 512)
        off.append(np.full(len(points), np.inf))
        off[-1][inside] = np.abs(z[inside] / frame.depth[v[inside], u[inside]] - 1)
    off = np.min(off, 0)
    assert np.median(off) < 0.01
    coarse = error > np.median(error)
    assert np.median(off[coarse]) > np.median(off[~coarse])  # rays that meet at a small angle tell less


def test_views_from_one_place_give_no_points(large):
    first = large[0]
    assert len(triangulate([first, first])[0]) == 0
    turned = first.camera.pose.copy()
    turned[:3, :3] = turned[:3, :3] @ cv2.Rodrigues(np.array([0.0, 0.05, 0.0]))[0]
    H = first.camera.K @ turned[:3, :3].T @ first.camera.pose[:3, :3] @ np.linalg.inv(first.camera.K)
    image = cv2.warpPerspective(first.image, H, (640, 512))
    rotated = bare(first, image=image, camera=first.camera.at(turned))
    assert len(triangulate([first, rotated])[0]) == 0


# ------------------------------------------------------------------------------------------- depth prior


def test_stereo_depth_is_near_the_exact_depth(large):
    prior = with_depth_prior(list(large[:2]), NO_POINTS, options(depth="stereo"))
    for frame, exact in zip(prior, large):
        valid = frame.depth > 0
        assert valid.mean() > 0.7
        assert np.median(np.abs(frame.depth - exact.depth)[valid]) < 0.002
        assert valid[:, :100].mean() > 0.3  # the columns that a matcher by itself would skip


def test_a_wrong_principal_point_of_the_right_eye_is_found(large):
    points = triangulate(list(large))
    right = [np.ascontiguousarray(np.roll(frame.right, -3, axis=1)) for frame in large]  # as if cx were 3 pixels less
    wrong = [dataclasses.replace(frame, right=image) for frame, image in zip(large, right)]
    offset = disparity_offsets(wrong, [stereo_disparity(frame) for frame in wrong], points)
    np.testing.assert_allclose(offset, -3, atol=0.25)
    K = large[0].camera.K - np.array([[0, 0, 3.0], [0, 0, 0], [0, 0, 0]])
    known = [dataclasses.replace(frame, right_K=K) for frame in wrong]
    assert disparity_offsets(known, [stereo_disparity(frame) for frame in known], points).max() == pytest.approx(0, abs=0.25)


def test_no_offset_without_points(large):
    assert disparity_offsets(list(large[:1]), [np.ones((512, 640), np.float32)], NO_POINTS) == 0


def test_depth_between_points_is_interpolated_without_the_wrong_ones(large):
    points, _, _ = triangulate(list(large))
    frame = large[0]
    wrong = points[::20] * 0.7
    depth = interpolated_depth(frame, np.concatenate([points, wrong]))
    valid = depth > 0
    assert valid.mean() > 0.4
    assert np.median(np.abs(depth / frame.depth - 1)[valid]) < 0.02
    assert interpolated_depth(frame, points[:10]) is None
    straight = frame.camera.at(np.eye(4))
    line = np.stack([np.linspace(-0.02, 0.02, 50), np.zeros(50), np.full(50, 0.1)], 1)
    assert interpolated_depth(dataclasses.replace(frame, camera=straight), line) is None


def _seen_at(frame, depth_of, count, random):
    """Points of a surface whose depth [N] (m) is given by pixels [N, 2], seen by an untilted camera."""
    camera = frame.camera.at(np.eye(4))
    uv = random.uniform(0, [camera.width, camera.height], (count, 2))
    z = depth_of(uv)
    rays = np.column_stack([(uv - camera.K[:2, 2]) / camera.K.diagonal()[:2], np.ones(count)])
    return dataclasses.replace(frame, camera=camera), rays * z[:, None], z


def test_depth_between_points_of_a_plane_is_the_plane(small):
    plane = lambda uv: 1 / (20 - uv @ [0.04, 0.03])
    frame, points, _ = _seen_at(small[0], plane, 400, np.random.default_rng(0))
    depth = interpolated_depth(frame, points)
    v, u = np.nonzero(depth)
    assert len(v) > 0.9 * depth.size
    np.testing.assert_allclose(depth[v, u], plane(np.column_stack([u, v]) + 0.5), rtol=1e-5)


def test_depth_between_points_that_err_is_better_than_theirs(small):
    random, surface = np.random.default_rng(0), lambda uv: 0.08 + 0.01 * np.sin(uv[:, 0] / 30) * np.cos(uv[:, 1] / 30)
    frame, points, _ = _seen_at(small[0], surface, 1500, random)
    points *= 1 + 0.02 * random.normal(size=(len(points), 1))
    depth = interpolated_depth(frame, points)
    v, u = np.nonzero(depth)
    off = depth[v, u] / surface(np.column_stack([u, v]) + 0.5) - 1
    assert np.sqrt((off**2).mean()) < 0.01


def test_depth_between_points_stays_among_theirs(small):
    random = np.random.default_rng(0)
    slopes = lambda uv: 0.03 + 0.12 * np.abs(uv[:, 0] / small[0].camera.width - 0.5) ** 0.5
    for towards in (slopes, lambda uv: 1 / slopes(uv) / 100):
        frame, points, z = _seen_at(small[0], towards, 600, random)
        gap = np.abs(frame.camera.project(points)[0][:, 0] / frame.camera.width - 0.5) < 0.2
        depth = interpolated_depth(frame, points[~gap])
        assert (depth > 0).mean() > 0.9
        assert depth[depth > 0].min() > z[~gap].min() / 1.25 and depth.max() < z[~gap].max() * 1.3


def test_views_that_see_few_points_are_told(small, caplog):
    points = ScenePoints(np.array([[0.0, 0.0, 0.1]] * 5), np.zeros((5, 3)))
    bare = [dataclasses.replace(frame, right=None, baseline=None, depth=None) for frame in small]
    with_depth_prior(bare, points, ReconstructionConfig(depth="points"))
    assert f"{len(small)} of {len(small)} views see fewer than 30 scene points" in caplog.text


def test_depth_between_points_is_believed_more_than_a_guess(large):
    off = [dataclasses.replace(frame, depth=frame.depth * np.float32(1.03)) for frame in large]
    moved = [np.abs(agreed(off, NO_POINTS, source)[0][0].depth - off[0].depth).mean() for source in ("points", "network")]
    assert moved[0] < moved[1]


def test_depth_prior_is_clean(small):
    depth = small[0].depth.copy()
    depth[0, :4] = [np.nan, np.inf, -1, 0]
    mask = np.full_like(small[0].mask, 255)
    mask[1] = 0
    (frame,) = with_depth_prior([dataclasses.replace(small[0], depth=depth, mask=mask)], NO_POINTS, options())
    assert (frame.depth[0, :4] == 0).all()
    assert (frame.depth[1] == 0).all()
    assert np.isfinite(frame.depth).all()
    assert (frame.depth[2:] == depth[2:]).all()


def test_depth_sources_are_chosen_or_refused(small):
    frame = small[0]
    assert with_depth_prior([frame], NO_POINTS, options(depth="none"))[0].depth is None
    with pytest.raises(SequenceError, match="depth=topic"):
        with_depth_prior([bare(frame)], NO_POINTS, options(depth="topic"))
    with pytest.raises(SequenceError, match="depth=stereo"):
        with_depth_prior([bare(frame)], NO_POINTS, options(depth="stereo"))


def test_each_view_has_its_own_offset_where_it_sees_many_points(large):
    points = triangulate(list(large))
    moved = [dataclasses.replace(f, right=np.ascontiguousarray(np.roll(f.right, -2 - i, axis=1))) for i, f in enumerate(large[:2])]
    offsets = disparity_offsets(moved, [stereo_disparity(frame) for frame in moved], points)
    np.testing.assert_allclose(offsets, [-2, -3], atol=0.3)


def test_an_offset_that_no_principal_point_explains_is_refused(large, caplog):
    points = triangulate(list(large))
    far = ScenePoints(2 * points.positions, points.colors, points.error)  # as of poses of twice the scale
    assert (disparity_offsets(list(large), [stereo_disparity(frame) for frame in large], far) == 0).all()
    assert "check poses, their scale and the baseline" in caplog.text


def test_small_islands_of_disparity_are_no_surface(large):
    frame = large[0]
    clean = stereo_disparity(frame)
    image, right = frame.image.copy(), frame.right.copy()
    patch = np.random.default_rng(0).integers(0, 255, (20, 20, 3), np.uint8)
    image[200:220, 300:320], right[200:220, 240:260] = patch, patch  # as if 2 cm before the tissue
    disparity = stereo_disparity(dataclasses.replace(frame, image=image, right=right))
    assert (disparity[202:218, 302:318] == 0).mean() > 0.9
    assert (disparity > 0).mean() > (clean > 0).mean() - 0.02


# ---------------------------------------------------------------------------------------- agreement of views


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


@pytest.mark.parametrize("pair", [plain_pair, dark_right, behind_a_tool, with_eyes_that_converge])
def test_flow_between_the_eyes_corrects_what_matching_left(large, pair):
    (matched,) = with_depth_prior([pair(large[0])], NO_POINTS, options(depth="stereo"))
    (corrected,), contradiction = agreed([matched], NO_POINTS, "stereo")
    error = lambda view: np.abs(view.depth - large[0].depth)[(matched.depth > 0) & (view.depth > 0)]
    assert np.median(error(corrected)) < 0.6 * np.median(error(matched))
    assert np.sqrt((error(corrected) ** 2).mean()) < 0.8 * np.sqrt((error(matched) ** 2).mean())
    assert np.isnan(contradiction)  # one view contradicts none


def test_flow_is_found_in_finer_pixels_than_are_trained_on(large):
    wide = trainer_of([dataclasses.replace(large[0], depth=None)], options(image_width=320))._frames[0]
    (matched,) = with_depth_prior([dataclasses.replace(large[0], depth=None)], NO_POINTS, options())
    (narrow,), _ = agreed([shrink(matched, 320)], NO_POINTS, "stereo")
    exact = shrink(large[0], 320).depth
    error = lambda depth: np.sqrt((((depth - exact)[(wide.depth_prior > 0) & (narrow.depth > 0)]) ** 2).mean())
    assert error(wide.depth_prior) < 0.95 * error(narrow.depth)


def test_reflections_of_the_light_do_not_spoil_the_depth_that_views_agree_on(large):
    """A reflection is seen where the tissue is not: through another view's depth it lies beside where that view has it."""
    frames = with_depth_prior(list(large[:2]), NO_POINTS, options(depth="stereo"))
    centres = np.array([(x, y) for x in range(160, 500, 80) for y in range(120, 420, 80)])
    lit, around = list(frames), np.zeros(frames[0].depth.shape, np.uint8)
    for i, (frame, aside) in enumerate(zip(frames, ((0, 0), (10, 6)))):
        image = frame.image.copy()
        uv, _ = frame.camera.project(frames[0].camera.backproject(large[0].depth)[centres[:, 1], centres[:, 0]])
        for place in uv + aside:
            cv2.circle(image, tuple(int(c) for c in place), 7, (255, 255, 255), -1)
        lit[i] = dataclasses.replace(frame, image=image)
    for x, y in centres:
        cv2.circle(around, (int(x), int(y)), 25, 1, -1)
    where = (around > 0) & (frames[0].depth > 0)
    error = lambda views: np.sqrt(((agreed(views, NO_POINTS, "network")[0][0].depth - large[0].depth)[where] ** 2).mean())
    assert error(lit) < 1.6 * error(frames)


def test_pale_tissue_is_no_reflection(large):
    pale = [dataclasses.replace(frame, image=(180 + frame.image // 4).astype(np.uint8)) for frame in large[:2]]
    off = [dataclasses.replace(frame, depth=frame.depth * np.float32(1.03), right=None, baseline=None) for frame in pale]
    corrected, _ = agreed(off, NO_POINTS, "network")
    assert all(np.median(np.abs(a.depth / b.depth - 1)) < 0.012 for a, b in zip(corrected, large))


def test_views_correct_each_others_depth(large):
    frames = with_depth_prior(list(large), NO_POINTS, options(depth="stereo"))
    corrected, contradiction = agreed(frames, NO_POINTS, "stereo")
    error = lambda views: np.median(np.concatenate([np.abs(v.depth - e.depth)[v.depth > 0] for v, e in zip(views, large)]))
    assert error(corrected) < 0.5 * error(frames)
    assert contradiction < 0.2
    assert all(((a.depth > 0) == (b.depth > 0)).mean() > 0.999 for a, b in zip(corrected, frames))


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
    corrected = agreed(views, NO_POINTS, "network")[0][0]
    hidden = (corrected.depth - views[0].depth)[150:350, 225:240]
    assert np.sqrt((hidden**2).mean()) < 0.0025  # twice as much where flow is believed that does not lead back


@pytest.mark.parametrize("kept", [np.s_[:6], np.s_[:, :9]])
def test_images_too_small_for_optical_flow_keep_their_depth(small, kept):
    cut = lambda array: np.ascontiguousarray(array[kept])
    views = []
    for frame in small[:2]:
        image, depth = cut(frame.image), cut(frame.depth)
        camera = dataclasses.replace(frame.camera, height=image.shape[0], width=image.shape[1])
        views.append(dataclasses.replace(bare(frame), image=image, depth=depth, mask=None, camera=camera))
    corrected, contradiction = agreed(views, NO_POINTS, "network")
    assert np.isnan(contradiction)
    assert all(np.abs(a.depth / b.depth - 1).max() < 0.02 for a, b in zip(corrected, views))


@pytest.mark.parametrize("known", [np.s_[20:21], np.s_[:, 20:21]])
def test_depth_in_one_line_is_continued_level_to_its_sides(known):
    """Of how depth changes across the line nothing is known."""
    (frame,) = film(40, 40, 1)
    line = np.zeros_like(frame.depth)
    line[known] = frame.depth[known]
    model = trainer_of([dataclasses.replace(bare(frame), depth=line)], options(depth="topic")).run()
    _, depth = frame.camera.project(model.means.numpy())
    assert len(model) > 100 and 0.7 * line[known].min() < depth.min() and depth.max() < 1.4 * line.max()


def test_no_pixel_is_corrected_to_another_surface():
    inverse, weight = np.full((64, 80), 10, np.float32), np.zeros((64, 80), np.float32)
    weight[20:40, 20:40] = 1e6
    corrected = _corrected(inverse, 9 * weight, weight, 0.1, 80, (10.0, 0.05))
    assert 12 < corrected.max() < 12.6 and corrected.min() > 9.9


def test_ripples_of_wide_images_are_smoothed_and_edges_are_not():
    width, noise = 1920, np.random.default_rng(0).normal(0, 0.1, (160, 1920))
    step = np.where(np.arange(width) < 960, 8.0, 12.0) + np.zeros_like(noise)
    error = _smooth((step + noise).astype(np.float32), width, (10.0, 0.05)) - step
    assert error.std() < 0.1 * noise.std()
    assert np.abs(error[:, 950:970]).max() < 0.5 * noise.std()


def test_of_depth_that_is_known_better_smaller_steps_are_kept():
    step = np.where(np.arange(640) < 320, 10.0, 10.4) + np.zeros((64, 640))
    off = [np.abs(_smooth(step.astype(np.float32), 640, ripples) - step)[:, 310:330].max() for ripples in (_MATCHED, _BY_EYES, _IN_THE_END)]
    assert off[0] > 0.15 and off[0] > off[1] > off[2] and off[2] < 0.07


def test_scene_points_correct_the_depth_around_them(large):
    frame = large[0]
    off = dataclasses.replace(frame, depth=frame.depth * np.float32(1.04), right=None, baseline=None)
    v, u = np.mgrid[8:512:16, 8:640:16].reshape(2, -1)
    positions = frame.camera.backproject(frame.depth)[v, u]
    (corrected,), contradiction = agreed([off], ScenePoints(positions, np.zeros_like(positions), 0.002), "network")
    assert np.median(np.abs(corrected.depth / frame.depth - 1)) < 0.01
    assert np.isnan(contradiction)  # one view contradicts none


def test_wrong_scene_points_among_good_ones_hardly_move_what_matching_knows(large):
    (matched,) = with_depth_prior([dataclasses.replace(large[0], depth=None)], NO_POINTS, options(depth="stereo"))
    v, u = np.mgrid[8:512:16, 8:640:16].reshape(2, -1)
    wrong = np.arange(len(u)) % 10 == 0  # 15 % too far, and as sure of themselves as all
    positions = large[0].camera.backproject(large[0].depth * np.float32(1.15))[v, u]
    good = large[0].camera.backproject(large[0].depth)[v, u]

    def error(positions):
        (corrected,), _ = agreed([matched], ScenePoints(positions, np.zeros_like(positions), 0.003), "stereo")
        return np.sqrt(((corrected.depth - large[0].depth)[matched.depth > 0] ** 2).mean())

    assert error(good[~wrong]) < error(np.where(wrong[:, None], positions, good)) < 2.5 * error(good[~wrong])


@pytest.mark.parametrize(
    "positions, error, said",
    [
        (np.full((9, 3), np.nan), 0.01, "not finite"),
        (np.ones((9, 3)), np.zeros(9), "above zero"),
        (np.ones((9, 3)), np.full(9, np.nan), "above zero"),
        (np.ones((9, 2)), 0.01, r"arrays \[N, 3\]"),
    ],
)
def test_scene_points_that_are_none_are_refused(large, positions, error, said):
    with pytest.raises(SequenceError, match=said):
        trainer_of(list(large[:1]), options(iterations=1), (positions, np.ones((len(positions), positions.shape[1])), error))


# ----------------------------------------------------------------------------------------- initial model


def test_initial_model_lies_on_the_surface_within_the_limit(small):
    model = initial_model(list(small[::4]), *NO_POINTS[:2], options(max_gaussians=3000))
    assert 2000 < len(model) <= 3000
    errors = []
    for frame in small[::4]:
        uv, z = frame.camera.project(model.means.numpy().astype(np.float64))
        u, v = np.floor(uv).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < 160) & (v < 128) & (z > 0)
        # Never in front of what a view sees by more than the tolerance.
        assert (z[inside] > frame.depth[v[inside], u[inside]] * 0.949).all()
        errors.append(np.abs(z[inside] / frame.depth[v[inside], u[inside]] - 1))
    assert np.median(np.concatenate(errors)) < 0.01


def test_depth_floating_in_front_of_another_view_is_left_out(small):
    first, second = small[0], small[4]
    depth = first.depth.copy()
    depth[50:70, 60:90] *= 0.6  # a floating patch
    model = initial_model([dataclasses.replace(first, depth=depth), second], *NO_POINTS[:2], options(max_gaussians=50_000))
    uv, z = second.camera.project(model.means.numpy().astype(np.float64))
    u, v = np.floor(uv).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < 160) & (v < 128)
    assert (z[inside] > 0.94 * second.depth[v[inside], u[inside]]).all()
    alone = initial_model([dataclasses.replace(first, depth=depth)], *NO_POINTS[:2], options(max_gaussians=50_000))
    assert float(alone.means[:, 2].min()) < 0.7 * first.depth.min() + first.camera.position[2]


def test_masked_pixels_give_no_gaussians(small):
    mask = np.zeros_like(small[0].mask)
    mask[:, :80] = 255
    model = initial_model([dataclasses.replace(small[0], mask=mask)], *NO_POINTS[:2], options())
    uv, _ = small[0].camera.project(model.means.numpy().astype(np.float64))
    assert uv[:, 0].max() < 80


# ----------------------------------------------------------------------------------------- densification


def cloud(count=300, seed=0):
    """Small Gaussians in front of a camera at the origin."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) * 0.06 + torch.tensor([-0.03, -0.03, 0.1])
    scales = torch.rand(count, generator=generator) * 1e-3 + 5e-4
    model = GaussianModel.from_points(means, torch.rand(count, 3, generator=generator), scales, 0.3)
    opacities = torch.rand(count, generator=generator) * 0.4 + 0.1
    return dataclasses.replace(model, logit_opacities=opacities.logit())


def test_copies_share_opacity_and_size():
    opacities, scales = torch.tensor([0.3, 0.99, 0.5]), torch.ones(3, 3)
    shared, smaller = relocated(opacities, scales, torch.tensor([2, 50, 1]), 50)
    torch.testing.assert_close(1 - (1 - shared) ** torch.tensor([2, 50, 1]), opacities)
    # Two copies by hand: 0.3 / (2 o − o² / √2) with o = 1 − √0.7.
    o = 1 - 0.7**0.5
    assert float(smaller[0, 0]) == pytest.approx(0.3 / (2 * o - o**2 / 2**0.5), rel=1e-6)
    assert float(smaller[2, 0]) == pytest.approx(1)
    assert torch.isfinite(smaller).all()


def test_refinement_preserves_the_picture_moves_the_dead_and_respects_the_limit():
    model = cloud()
    logits = model.logit_opacities.clone()
    logits[::6] = -7  # dead
    model = dataclasses.replace(model, logit_opacities=logits)
    camera = Camera(np.array([[80.0, 0, 40], [0, 80, 40], [0, 0, 1]]), 80, 80)
    before = render(model, camera)
    new, source, fresh = STRATEGIES["mcmc"](McmcConfig(), 310, 0.1).refine(model, {}, torch.Generator().manual_seed(0))
    after = render(new, camera)
    assert len(new) == len(source) == len(fresh) == 310
    assert (new.opacities > McmcConfig().dead_opacity).all()
    assert not (source[:300:6] == torch.arange(0, 300, 6)).any()
    assert fresh[:300:6].all()
    assert fresh[300:].all()
    torch.testing.assert_close(new.means, model.means[source])
    untouched = ~fresh[:300]
    torch.testing.assert_close(new.log_scales[:300][untouched], model.log_scales[untouched])
    assert float((after.colors - before.colors).abs().mean()) < 0.02 * float(before.colors.mean())


def test_refinement_without_any_living_gaussian_changes_nothing():
    model = dataclasses.replace(cloud(20), logit_opacities=torch.full((20,), -9.0))
    new, source, fresh = STRATEGIES["mcmc"](McmcConfig(growth=0.5), 100, 0.1).refine(model, {}, torch.Generator())
    assert equal(new, model)
    assert len(source) == len(fresh) == 20
    assert not fresh.any()


def test_noise_moves_only_the_faint():
    model = cloud(50)
    model.logit_opacities[:25] = -7
    noise = exploration_noise(model, 1.0, 0.005, torch.Generator().manual_seed(0))
    assert noise[:25].abs().min() > 0
    assert noise[25:].abs().max() < 1e-3 * noise[:25].abs().median()


def test_optimiser_state_follows_its_gaussians(small):
    trainer = trainer_of([small[0], small[8]], options(refine_every=1000, max_gaussians=1500))
    for _ in range(3):
        trainer.step()
    with torch.no_grad():
        trainer._parameters["logit_opacities"][:7] = -8
    state = lambda: trainer._optimizer.state["means"]
    moments, means = state()["exp_avg"].clone(), trainer.model.means
    trainer._refine()
    kept = (trainer.model.means[: len(means)] == means).all(1) & (state()["exp_avg"][: len(means)] != 0).any(1)
    assert kept.sum() > 0.5 * len(means)
    assert not kept[:7].any()
    torch.testing.assert_close(state()["exp_avg"][: len(means)][kept], moments[kept])
    assert float(state()["step"]) == 3
    trainer.step()


# ---------------------------------------------------------------------------------------------- training


def test_adam_is_that_of_torch():
    g = torch.Generator().manual_seed(0)
    start = {name: torch.randn(shape, generator=g) for name, shape in (("means", (20, 3)), ("logit_opacities", (20,)))}
    rates = {"means": 1e-3, "logit_opacities": 0.05}
    ours, theirs = ({name: x.clone().requires_grad_() for name, x in start.items()} for _ in range(2))
    optimizer = Adam(ours, rates)
    reference = torch.optim.Adam([{"params": [x], "lr": rates[name]} for name, x in theirs.items()], eps=1e-15)
    for step in range(5):
        optimizer.set_rate("means", 1e-3 / (step + 1))
        reference.param_groups[0]["lr"] = 1e-3 / (step + 1)
        for name, x in theirs.items():
            x.grad = torch.randn(x.shape, generator=g)
        optimizer.step({name: x.grad for name, x in theirs.items()})
        reference.step()
    for name, x in ours.items():
        torch.testing.assert_close(x, theirs[name])
        assert not torch.equal(x, start[name])


def test_virtual_camera_lies_between_two_views(small, monkeypatch):
    trainer = trainer_of([small[0], small[4]], options(virtual_every=1))
    first, second = (small[i].camera.position for i in (0, 4))
    seen = []
    draw = trainer._render

    def spy(viewmats, *arguments):
        seen.extend(viewmats.double().inverse()[:, :3, 3].numpy())
        return draw(viewmats, *arguments)

    monkeypatch.setattr(trainer, "_render", spy)
    for _ in range(3):
        trainer.step()
    virtual = seen[1::2]
    assert len(virtual) == 3
    for position in virtual:
        alpha = np.dot(position - first, second - first) / np.dot(second - first, second - first)
        assert 0 < alpha < 1
        np.testing.assert_allclose(position, (1 - alpha) * first + alpha * second, atol=1e-7)


def test_training_improves_views_it_has_not_seen(small):
    training, rest = [small[i] for i in (0, 2, 4, 6)], [small[i] for i in (1, 3, 5)]
    noisy = [dataclasses.replace(f, depth=f.depth * np.float32(1.03 if i % 2 else 0.97)) for i, f in enumerate(training)]
    trainer = trainer_of(noisy, options(iterations=150, max_gaussians=8000, refine_every=50))
    psnr, _ = held_out(trainer.model, rest)
    given_error = 0.03 * np.mean([np.sqrt(np.mean(f.depth[f.depth > 0] ** 2)) for f in training])
    reports = []
    model = trainer.run(lambda progress: reports.append(progress), every=50)
    trained_psnr, trained_error = held_out(model, rest)
    assert trained_psnr > psnr + 2.5
    assert trained_error < 0.85 * given_error
    assert [report.iteration for report in reports] == [50, 100, 150]
    assert reports[-1].gaussians == len(model) <= 8000


def test_progress_can_stop_the_training(small):
    trainer = trainer_of([small[0]], options())
    trainer.run(lambda progress: False, every=2)
    assert trainer.iteration == 2


def test_same_seed_gives_the_same_bits_whatever_the_threads(small, monkeypatch):
    models = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("ENDO_SIM_THREADS", threads)
        torch.set_num_threads(int(threads))
        try:
            models.append(trainer_of(list(small[::4]), options(max_gaussians=15_000)).run())
        finally:
            torch.set_num_threads(1)
    assert equal(models[0], models[1])
    assert equal(models[0], models[2])
    other = trainer_of(list(small[::4]), options(max_gaussians=15_000, seed=1)).run()
    assert not equal(models[0], other)


def test_a_checkpoint_goes_on_as_if_never_interrupted(small, tmp_path):
    views = list(small[::4])
    whole = trainer_of(views, options()).run()
    first = trainer_of(views, options())
    for _ in range(7):
        first.step()
    first.save_checkpoint(tmp_path / "a" / "checkpoint.pt")
    second = trainer_of(views, options())
    second.load_checkpoint(tmp_path / "a" / "checkpoint.pt")
    assert second.iteration == 7
    assert equal(second.run(), whole)


def test_checkpoints_that_do_not_fit_are_refused(small, tmp_path):
    path = tmp_path / "checkpoint.pt"
    trainer = trainer_of([small[0]], options())
    trainer.save_checkpoint(path)
    with pytest.raises(SequenceError, match=r"other options \(seed\)"):
        trainer_of([small[0]], options(seed=3)).load_checkpoint(path)
    with pytest.raises(SequenceError, match="other views"):
        trainer_of([small[1]], options()).load_checkpoint(path)
    state = torch.load(path, weights_only=True)
    torch.save(state | {"config": state["config"] | {"lambda_gone": 0.3}}, path)  # of another version, which asked for more
    with pytest.raises(SequenceError, match=r"other options \(lambda_gone\)"):
        trainer.load_checkpoint(path)
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(SequenceError, match="not a readable checkpoint"):
        trainer.load_checkpoint(path)
    with pytest.raises(SequenceError, match="not a readable checkpoint"):
        trainer.load_checkpoint(tmp_path / "absent.pt")


def test_higher_harmonics_are_trained(small):
    model = trainer_of([small[0], small[8]], options(sh_degree=3)).run()
    assert model.sh_degree == 3
    assert model.sh[:, 1:].abs().max() > 0


def test_reconstruction_of_a_bag_is_measured(tmp_path, small):
    write_bag(tmp_path / "bag", small)
    found = reconstruct_and_measure(tmp_path / "bag", tmp_path / "out", options(keyframes=4, image_width=80))
    assert found["held_out_views"] == 5
    assert found["psnr"] > 15
    assert found["depth_rmse"] < 0.010
    for name in ("model.ply", "checkpoint.pt", "held_out.png"):
        assert (tmp_path / "out" / name).stat().st_size > 0


# -------------------------------------------------------------------------------------------- bad inputs


def finite(model):
    return all(bool(tensor.isfinite().all()) for tensor in model.tensors().values())


def test_no_views_is_one_clear_error():
    with pytest.raises(SequenceError, match="no views"):
        trainer_of([], options())


def test_one_view_is_enough_with_depth(small):
    assert finite(trainer_of([small[0]], options()).run())


def test_identical_views_train(small, caplog):
    assert finite(trainer_of([small[0]] * 3, options()).run())
    assert "contradict what they see" not in caplog.text


def test_masking_everything_is_an_error(small):
    hidden = dataclasses.replace(small[0], mask=np.zeros_like(small[0].mask))
    with pytest.raises(SequenceError, match="masked"):
        trainer_of([hidden], options())
    assert finite(trainer_of([small[4], hidden], options()).run())  # one of them is no obstacle


def test_depth_with_holes_trains(small):
    depth = small[0].depth.copy()
    depth[:, :60], depth[:40] = np.nan, 0
    empty = dataclasses.replace(small[4], depth=np.zeros_like(depth))
    assert finite(trainer_of([dataclasses.replace(small[0], depth=depth), empty], options()).run())


def test_nothing_to_see_is_an_error(small):
    flat = np.full_like(small[0].image, 128)
    with pytest.raises(SequenceError, match="only 0 scene points"):
        trainer_of([bare(small[0], image=flat), bare(small[4], image=flat)], options())
    with pytest.raises(SequenceError, match="only 0 scene points"):
        trainer_of([dataclasses.replace(bare(small[0]), depth=np.zeros_like(small[0].depth))], options())


def test_views_that_face_away_from_each_other_train(small):
    away = small[4].camera.pose @ np.diag([-1.0, 1, -1, 1])
    other = dataclasses.replace(small[4], camera=small[4].camera.at(away))
    assert finite(trainer_of([small[0], other], options()).run())


def test_points_alone_are_enough(large):
    model = trainer_of([bare(frame) for frame in large[:3]], options(image_width=160)).run()
    assert finite(model)
    assert len(model) > 100


def test_odd_sizes_train():
    frames = film(161, 97, 3)
    model = trainer_of(list(frames[::2]), options(image_width=75)).run()
    assert finite(model)


def test_depth_extent_sees_needles_along_the_line_of_sight_only():
    eye, angle = torch.tensor([0.0, 0.0, -0.1]), np.pi / 4
    turned = [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]  # the z axis turns towards x
    quats = torch.tensor([[1.0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0], turned], dtype=torch.float32)
    scales = torch.tensor([[1.0, 1, 1], [4, 4, 1], [1, 1, 6], [1, 1, 6]]) * 1e-3
    model = GaussianModel(torch.zeros(4, 3), quats, scales.log(), torch.zeros(4), torch.zeros(4, 1, 3))
    model.log_scales.requires_grad_()
    extent = losses.depth_extent(model, eye, 1.5)
    # A sphere and a disc across the view are fine; a needle along it is 6 times as deep as wide, a turned one less.
    deep, wide = (1 + 36) / 2, (1 + (1 + 36) / 2) / 2
    expected = [0, 0, np.log(6 / 1.5), 0.5 * np.log(deep / wide) - np.log(1.5)]
    np.testing.assert_allclose(extent.detach(), np.maximum(expected, 0), atol=1e-5)
    extent[2].backward()
    assert model.log_scales.grad[2, 2] > 0 > model.log_scales.grad[2, 0] and not model.log_scales.grad[:2].any()


def test_no_gaussian_outgrows_the_scene():
    frames = list(phantom_sequence(PhantomConfig(frames=4, width=96, height=80, border=0.1)))
    trainer = trainer_of(frames, ReconstructionConfig(iterations=60, max_gaussians=1000, device="cpu", learning_rate=5.0))
    trainer.run()
    assert trainer.model.scales.max() <= 0.06 * trainer.scene_depth * 1.001


def test_points_that_float_before_the_surface_or_before_a_hole_of_it_do_not_become_gaussians(small):
    frame, camera = small[0], small[0].camera
    depth = frame.depth.copy()
    row, column = camera.height // 2, camera.width // 2
    true = float(depth[row, column])
    depth[row - 10 : row + 11, column - 10 : column + 11] = 0  # a highlight: no depth there
    ray = camera.backproject(np.ones_like(depth))[row, column] - camera.position
    points = camera.position + ray * np.array([[0.5 * true], [true], [0.98 * true]])
    points = np.concatenate([points, points + 1e-4])
    views = [dataclasses.replace(frame, depth=depth)]
    model = initial_model(views, points, np.full((6, 3), 0.5), options(max_gaussians=50_000))
    z = camera.project(model.means.double().numpy())[1]
    assert z.min() > 0.9 * frame.depth[frame.depth > 0].min()
    near = np.linalg.norm(model.means.double().numpy()[:, None] - points, axis=2).min(0)
    assert (near[[1, 2, 4, 5]] < 1e-6).all() and (near[[0, 3]] > 0.01).all()
