"""Depth away from scene points, by matching views plane by plane."""

import dataclasses
import re

import cv2
import numpy as np
import pytest
import torch
from short_training import options_of_depth

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.kernels import launch, load_kernels
from endo_sim_ros.reconstruction.pipeline import sweep_planes
from endo_sim_ros.reconstruction.priors import sweep_kernels
from endo_sim_ros.reconstruction.priors.plane_sweep import costs_by_kernels, costs_by_opencv, picture_of, sweep_depth
from endo_sim_ros.reconstruction.priors.sources import estimate_depth
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import PreparedScene, ScenePoints, TrainingView, shrink
from endo_sim_ros.reconstruction.stage_configs import ExtrapolationConfig, PlaneSweepConfig

pytestmark = pytest.mark.slow
NEAR, FAR = 0.06, 0.1  # m
WIDTH, HEIGHT = 160, 128


def texture(seed, contrast=60):
    noise = np.random.default_rng(seed).normal(size=(600, 600, 3)).astype(np.float32)
    return np.clip(128 + contrast * 3 * cv2.GaussianBlur(noise, (0, 0), 3), 0, 255).astype(np.uint8)


def wall_behind_a_band(x, contrast=60):
    """A view from x (m), with its true depth: a wall, and before it a band that is 2 cm wide."""
    pose = np.eye(4)
    pose[0, 3] = x
    camera = Camera(intrinsic_matrix(150, 150, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT, pose)
    image, depth = None, None
    for z, painted in ((FAR, texture(0, contrast)), (NEAR, texture(1, contrast))):
        places = camera.backproject(np.full((HEIGHT, WIDTH), z))
        u, v = ((places[..., axis] * 3000 + 300).astype(np.float32) for axis in (0, 1))
        seen = cv2.remap(painted, u, v, cv2.INTER_LINEAR)
        band = np.abs(places[..., 0]) < 0.01
        image = seen if image is None else np.where(band[..., None], seen, image)
        depth = np.full((HEIGHT, WIDTH), z, np.float32) if depth is None else np.where(band, np.float32(z), depth)
    return TrainingView(0, np.ascontiguousarray(image), camera), depth


def interpolated(count=5, contrast=60, along=12):
    """Views, true depths, points in two rows of the picture on either side of the band and on it, and views with depth between those."""
    views, truths = zip(*(wall_behind_a_band(x, contrast) for x in np.linspace(-0.006, 0.006, count)))
    xs, ys = np.meshgrid([-0.03, -0.024, -0.005, 0.0, 0.005, 0.024, 0.03], np.linspace(-0.02, 0.02, along))
    zs = np.where(np.abs(xs) < 0.01, NEAR, FAR)
    points = np.stack([xs, ys, zs], -1).reshape(-1, 3)
    found = ScenePoints.recorded(points, np.full(points.shape, 0.5))
    return list(views), truths, found, estimate_depth(views, found, options_of_depth(depth="points"))


def share_right(view, truth, of=slice(None)):
    """Share of the pixels whose depth is right to 3 %, of those with depth."""
    known = view.depth_prior[of] > 0
    return (np.abs(view.depth_prior[of] / truth[of] - 1) < 0.03)[known].mean()


def test_the_sweep_finds_the_edges_that_interpolation_blurs():
    _, truths, points, views = interpolated()
    swept = sweep_depth(views, points.positions, 0.05)
    for before, after, truth in zip(views, swept, truths):
        assert share_right(before, truth) < 0.5
        assert share_right(after, truth) > 0.88
        assert (after.depth_prior > 0).mean() > 0.75


def test_something_in_front_of_the_tissue_is_found_without_points_on_it():
    frames, truths, points, _ = interpolated()
    behind = np.flatnonzero(points.positions[:, 2] == FAR)
    points = ScenePoints.recorded(points.positions[behind], points.colors[behind])
    views = estimate_depth(frames, points, options_of_depth(depth="points"))
    for before, after, truth in zip(views, sweep_depth(views, points.positions, 0.05), truths):
        band = truth == np.float32(NEAR)
        assert share_right(before, truth, band) == 0
        assert share_right(after, truth, band) > 0.9 and (after.depth_prior[band] > 0).mean() > 0.8


def test_interpolated_depth_stays_near_points_alone_where_nothing_can_be_matched():
    _, truths, points, views = interpolated(contrast=0)
    for before, after, truth in zip(views, sweep_depth(views, points.positions, 0.05), truths):
        known = after.depth_prior > 0
        assert (after.depth_prior[known] == before.depth_prior[known]).all()
        assert known.mean() < 0.6 * (before.depth_prior > 0).mean()
        assert share_right(after, truth) > share_right(before, truth)


def test_two_views_are_not_swept():
    """One other view may agree by accident."""
    _, _, points, views = interpolated(count=2)
    for before, after in zip(views, sweep_depth(views, points.positions, 0.05)):
        known = after.depth_prior > 0
        assert known.any() and (after.depth_prior[known] == before.depth_prior[known]).all()


def test_masked_pixels_are_neither_matched_nor_given_depth():
    _, truths, points, views = interpolated()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :40] = 0
    masked = [dataclasses.replace(view, mask=mask, depth_prior=np.where(mask > 0, view.depth_prior, 0)) for view in views]
    for after, truth in zip(sweep_depth(masked, points.positions, 0.05), truths):
        assert not after.depth_prior[:, :40].any()
        assert share_right(after, truth) > 0.86


def test_dirt_on_the_lens_is_not_tissue_far_away():
    """It stands still in all pictures, as what is infinitely far does."""
    _, _, points, views = interpolated()
    dirt = texture(2)[:40, :40]
    for view in views:
        view.image[:40, :40] = dirt
    for view in sweep_depth(views, points.positions, 0.05, PlaneSweepConfig(margin=1.5)):
        assert view.depth_prior.max() < 2 * FAR


def smoothed(view, deviation):
    return dataclasses.replace(view, image=cv2.GaussianBlur(view.image, (0, 0), deviation), depth_prior=None)


def test_smooth_tissue_without_points_is_matched_in_shrunk_pictures():
    """Depth comes in the unit of the poses, however near together that brings the cameras."""
    views, truths, _, _ = interpolated(count=3)
    unit = 1e-6
    rng, pictures = np.random.default_rng(0), []
    for view in views:
        view = smoothed(view, 4)
        pose = view.camera.pose.copy()
        pose[:3, 3] *= unit
        noisy = np.clip(view.image + rng.normal(0, 2, view.image.shape), 0, 255).astype(np.uint8)
        pictures.append(dataclasses.replace(view, image=noisy, camera=view.camera.at(pose)))
    fine = sweep_depth(pictures, np.empty((0, 3)), 0.05, PlaneSweepConfig(levels=1))
    assert sum((view.surface > 0).mean() for view in fine) < 0.1
    for view, truth in zip(sweep_depth(pictures, np.empty((0, 3)), 0.05), truths):
        known = view.surface > 0
        error = np.abs(view.surface / unit / truth - 1)[known]
        assert known.mean() > 0.65 and np.median(error) < 0.08 and (error > 0.1).mean() < 0.25


def test_cameras_in_one_place_tell_no_depth():
    views, _, _, _ = interpolated()
    still = [dataclasses.replace(smoothed(view, 0.5), image=views[0].image, camera=views[0].camera) for view in views]
    assert all(view.depth_prior is None for view in sweep_depth(still, np.empty((0, 3)), 0.05))


def test_stray_matches_are_nothing_to_start_from():
    frames, _, _, views = interpolated(count=2)
    plain = tuple(dataclasses.replace(view, depth_prior=None) for view in views)
    scene = PreparedScene(tuple(frames), plain, points=ScenePoints.none(), depth_source="points")
    for fewest, some in ((0.02, True), (0.99, False)):
        after = sweep_planes(scene, options_of_depth(extrapolated=ExtrapolationConfig(min_coverage=fewest)), StageProgress())
        assert any(view.depth_prior is not None for view in after.views) == some
        none = re.search(r"unknown for (\d+)%(, for which it is guessed)?", after.decisions[-1])
        assert none and (none[1] != "100") == some and bool(none[2]) == (50 < int(none[1]) < 100)


@pytest.mark.parametrize(("given", "swept"), [({}, True), ({"plane_sweep": False}, False)])
def test_the_stage_sweeps_interpolated_depth_and_tells_so(given, swept):
    frames, _, points, views = interpolated()
    scene = PreparedScene(tuple(frames), tuple(views), points=points, depth_source="points")
    after = sweep_planes(scene, options_of_depth(**given), StageProgress())
    assert (after.views is not scene.views) == swept
    shares = r"depth is interpolated near scene points for (\d+)% of the tissue, matched .* for (\d+)%, and unknown for (\d+)%"
    found = [match for sentence in after.decisions if (match := re.fullmatch(shares, sentence))]
    assert len(found) == swept and all(abs(sum(map(int, match.groups())) - 100) <= 1 for match in found)
    measured = dataclasses.replace(scene, depth_source="stereo")
    assert sweep_planes(measured, options_of_depth(**given), StageProgress()) is measured


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("window, count", [(9, 5), (6, 2), (5, 4)])
def test_costs_of_kernels_are_those_of_opencv(window, count, device):
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    settings = PlaneSweepConfig(window=window)
    views = [wall_behind_a_band(x)[0] for x in np.linspace(-0.006, 0.006, count)]
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :30] = 0
    views[0] = dataclasses.replace(views[0], mask=mask)
    views[1] = shrink(views[1], WIDTH // 2)  # another size
    own, *others = (picture_of(view, settings) for view in views)
    planes = np.array([[0, 0, 1 / FAR], [0, 0, 1 / NEAR], [0.02, -0.01, 12.0], [0, 0, -3.0]])
    expected = costs_by_opencv(own, others, planes, settings, "cpu", StageProgress()).numpy()
    found = costs_by_kernels(own, others, planes, settings, device, StageProgress()).cpu().numpy()
    assert (expected < 0.3).mean() > 0.1 and (expected == 1).mean() > 0.1
    # OpenCV takes pictures at 32nds of a pixel, which decides where next to nothing is in a window, or its edge.
    assert np.abs(found - expected).mean() < 0.005
    assert np.quantile(np.abs(found - expected), 0.99) < 0.05


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def test_costs_are_aggregated_as_published(device):
    """Hirschmüller 2008, eq. 13, pixel by pixel."""
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    costs = np.random.default_rng(0).random((7, 9, 70)).astype(np.float32)
    height, width, levels = costs.shape
    small, large = 0.1, 0.3
    lanes = 1 if device == "cpu" else sweep_kernels.WARP
    load_kernels((sweep_kernels,), device)
    for down, across in [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)]:
        expected = costs.astype(np.float64)
        rows = range(height) if down >= 0 else reversed(range(height))
        for row in rows:
            for column in range(width) if across >= 0 else reversed(range(width)):
                if not (0 <= row - down < height and 0 <= column - across < width):
                    continue
                before = expected[row - down, column - across]
                steps = np.pad(before, 1, constant_values=np.inf)
                best = np.minimum.reduce([before, steps[:-2] + small, steps[2:] + small, np.full(levels, before.min() + large)])
                expected[row, column] += best - before.min()
        given, totals = torch.from_numpy(costs).to(device), torch.zeros(costs.shape, device=device)
        scratch = torch.empty(height + width, 2, levels, device=device)
        launch(sweep_kernels.aggregate, lanes * (height + width), [given, down, across, small, large, lanes, scratch, totals], device)
        np.testing.assert_allclose(totals.cpu().numpy(), expected, atol=1e-5)


def ball_before_a_wall(degrees):
    """A view from that far round a ball of 2 cm, with its true depth; a wall is 3.5 cm behind the middle of the ball."""
    angle = np.radians(degrees)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = -0.09 * pose[:3, 2]
    camera = Camera(intrinsic_matrix(150, 150, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT, pose)
    rays, eye = camera.rays() @ pose[:3, :3].T, pose[:3, 3]  # of depth 1
    square, half = (rays**2).sum(-1), rays @ eye
    inside = half**2 - square * (eye @ eye - 0.02**2)
    depth = np.where(inside > 0, (-half - np.sqrt(np.maximum(inside, 0))) / square, (0.035 - eye[2]) / rays[..., 2]).astype(np.float32)
    places, rng = (eye + depth[..., None] * rays)[..., None, :], np.random.default_rng(0)
    waves, starts = rng.normal(0, 400, (3, 24, 3)), rng.uniform(0, 6, (3, 24))  # 1/m, of each channel
    image = 128 + 18 * np.sin((places[..., None, :] * waves).sum(-1) + starts).sum(-1)
    return TrainingView(0, np.clip(image, 0, 255).astype(np.uint8), camera), depth, inside > 0


def test_what_is_in_front_of_the_tissue_is_found_in_views_far_apart_and_points_behind_it_tell_nothing():
    """Of three views 50° apart two see a place alike at most, and points on the wall are seen past the ball by another view."""
    frames, truths, balls = zip(*(ball_before_a_wall(degrees) for degrees in (-50, 0, 50)))
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 24), np.linspace(-0.04, 0.04, 18))
    points = np.stack([x, y, np.full(x.shape, 0.035)], -1).reshape(-1, 3)
    views = estimate_depth(frames, ScenePoints.recorded(points, np.full(points.shape, 0.5)), options_of_depth(depth="points"))
    for before, after, truth, ball in zip(views, sweep_depth(views, points, 0.05), truths, balls):
        assert share_right(before, truth, ball) == 0 and (before.surface[ball] > 0).mean() > 0.6
        assert share_right(after, truth, ball) > 0.4 and share_right(after, truth, ~ball) > 0.95
        assert (after.surface[ball] > 0).mean() > 0.5 and (after.surface[~ball] > 0).mean() > 0.3
