"""The depth prior: stereo, interpolated between points, chosen or refused."""

import dataclasses

import cv2
import numpy as np
import pytest
from peak_memory import peak_of
from short_training import NO_POINTS, bare, options
from training_views import unknown

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.reconstruction.priors.sources import depth_source, estimate_depth, interpolate_points
from endo_sim_ros.reconstruction.priors.stereo import align_rows, disparity_offsets, right_view, stereo_depth, stereo_disparity
from endo_sim_ros.reconstruction.scene import ScenePoints
from endo_sim_ros.reconstruction.stage_configs import StereoConfig
from endo_sim_ros.reconstruction.triangulation import triangulate


@pytest.mark.slow
def test_stereo_depth_is_near_the_exact_depth(large):
    for view, exact in zip(estimate_depth(unknown(large[:2]), NO_POINTS, options(depth="stereo")), large):
        valid = view.depth_prior > 0
        assert valid.mean() > 0.7
        assert np.median(np.abs(view.depth_prior - exact.depth)[valid]) < 0.002
        assert view.depth is exact.depth  # what was measured stays
        assert valid[:, :100].mean() > 0.3  # the columns that a matcher by itself would skip


def test_tissue_nearer_than_any_laparoscope_is_found_by_its_features(small, caplog):
    view = unknown(small[:1])[0]
    grey = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, view.image.shape[:2]).astype(np.float32), (0, 0), 1.5)
    image = np.repeat(cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)[..., None], 3, -1)
    apart = view.camera.width // 4
    pair = dataclasses.replace(view, image=image, right=np.roll(image, -apart, 1), right_K=None, mask=None)
    depth = view.camera.K[0, 0] * pair.baseline / apart
    near = StereoConfig(nearest=3 * depth)
    caplog.set_level("INFO")
    ((_, found),) = stereo_depth([pair], NO_POINTS, near)
    middle = found[:, apart + 8 :]
    assert (middle > 0).mean() > 0.9 and np.median(middle[middle > 0]) == pytest.approx(depth, rel=0.02)
    assert "features of stereo pairs lie nearer" in caplog.text


@pytest.mark.slow
def test_a_wrong_principal_point_of_the_right_eye_is_found(large):
    points = triangulate(list(large))
    right = [np.ascontiguousarray(np.roll(frame.right, -3, axis=1)) for frame in large]  # as if cx were 3 pixels less
    wrong = [dataclasses.replace(frame, right=image) for frame, image in zip(large, right)]
    disparities = [stereo_disparity(frame) for frame in wrong]
    np.testing.assert_allclose(disparity_offsets(wrong, disparities, points), -3, atol=0.25)
    many = lambda: disparity_offsets(8 * wrong, 8 * disparities, points)
    assert peak_of(many) < 0.3 * 8 * sum(disparity.nbytes for disparity in disparities) / 1e6, "copies of them all take gigabytes"
    K = large[0].camera.K - np.array([[0, 0, 3.0], [0, 0, 0], [0, 0, 0]])
    known = [dataclasses.replace(frame, right_K=K) for frame in wrong]
    assert disparity_offsets(known, [stereo_disparity(frame) for frame in known], points).max() == pytest.approx(0, abs=0.25)


@pytest.mark.thorough
@pytest.mark.slow
def test_disparities_of_many_views_are_held_in_two_bytes_until_their_depth_is(small, monkeypatch):
    monkeypatch.setenv("ENDO_SIM_THREADS", "1")  # each thread has arrays of its own

    match = lambda count: stereo_depth(unknown(count * small[:1]), NO_POINTS)
    peak_of(lambda: match(2))  # what is made once
    pixels = small[0].camera.width * small[0].camera.height / 1e6
    assert peak_of(lambda: match(40)) - peak_of(lambda: match(20)) < 1.25 * 20 * 4 * pixels


@pytest.mark.slow
def test_no_offset_without_points(large):
    assert disparity_offsets(list(large[:1]), [np.ones((512, 640), np.float32)], NO_POINTS) == 0


@pytest.mark.slow
def test_depth_between_points_is_interpolated_without_the_wrong_ones(large):
    points, _, _ = triangulate(list(large))
    frame = large[0]
    wrong = points[::20] * 0.7
    depth = interpolate_points(frame, np.concatenate([points, wrong]))
    valid = depth > 0
    assert valid.mean() > 0.4
    assert np.median(np.abs(depth / frame.depth - 1)[valid]) < 0.02
    assert interpolate_points(frame, points[:10]) is None
    straight = frame.camera.at(np.eye(4))
    line = np.stack([np.linspace(-0.02, 0.02, 50), np.zeros(50), np.full(50, 0.1)], 1)
    assert interpolate_points(dataclasses.replace(frame, camera=straight), line) is None


def _seen_at(frame, depth_of, count, random):
    """Points of a surface whose depth [N] (m) is given by pixels [N, 2], seen by an untilted camera."""
    camera = frame.camera.at(np.eye(4))
    uv = random.uniform(0, [camera.width, camera.height], (count, 2))
    z = depth_of(uv)
    rays = np.column_stack([(uv - camera.K[:2, 2]) / camera.K.diagonal()[:2], np.ones(count)])
    return dataclasses.replace(frame, camera=camera), rays * z[:, None], z


@pytest.mark.slow
def test_depth_between_points_of_a_plane_is_the_plane(small):
    plane = lambda uv: 1 / (20 - uv @ [0.04, 0.03])
    frame, points, _ = _seen_at(small[0], plane, 400, np.random.default_rng(0))
    depth = interpolate_points(frame, points)
    v, u = np.nonzero(depth)
    assert len(v) > 0.9 * depth.size
    np.testing.assert_allclose(depth[v, u], plane(np.column_stack([u, v]) + 0.5), rtol=1e-5)


@pytest.mark.slow
def test_depth_between_points_that_err_is_better_than_theirs(small):
    random, surface = np.random.default_rng(0), lambda uv: 0.08 + 0.01 * np.sin(uv[:, 0] / 30) * np.cos(uv[:, 1] / 30)
    frame, points, _ = _seen_at(small[0], surface, 1500, random)
    points *= 1 + 0.02 * random.normal(size=(len(points), 1))
    depth = interpolate_points(frame, points)
    v, u = np.nonzero(depth)
    off = depth[v, u] / surface(np.column_stack([u, v]) + 0.5) - 1
    assert np.sqrt((off**2).mean()) < 0.01


@pytest.mark.slow
def test_depth_between_points_stays_among_theirs(small):
    random = np.random.default_rng(0)
    slopes = lambda uv: 0.03 + 0.12 * np.abs(uv[:, 0] / small[0].camera.width - 0.5) ** 0.5
    for towards in (slopes, lambda uv: 1 / slopes(uv) / 100):
        frame, points, z = _seen_at(small[0], towards, 600, random)
        gap = np.abs(frame.camera.project(points)[0][:, 0] / frame.camera.width - 0.5) < 0.2
        depth = interpolate_points(frame, points[~gap])
        assert (depth > 0).mean() > 0.9
        assert depth[depth > 0].min() > z[~gap].min() / 1.25 and depth.max() < z[~gap].max() * 1.3


def test_views_that_see_few_points_are_told(small, caplog):
    points = ScenePoints(np.array([[0.0, 0.0, 0.1]] * 5), np.zeros((5, 3)))
    estimate_depth(unknown(bare(frame) for frame in small), points, options(depth="points"))
    assert f"fewer than 30 scene points agree in {len(small)} of {len(small)} views" in caplog.text


def test_depth_prior_is_clean(small):
    depth = small[0].depth.copy()
    depth[0, :4] = [np.nan, np.inf, -1, 0]
    mask = np.full_like(small[0].mask, 255)
    mask[1] = 0
    (view,) = estimate_depth(unknown([dataclasses.replace(small[0], depth=depth, mask=mask)]), NO_POINTS, options())
    assert (view.depth_prior[0, :4] == 0).all()
    assert (view.depth_prior[1] == 0).all()
    assert np.isfinite(view.depth_prior).all()
    assert (view.depth_prior[2:] == depth[2:]).all()


def test_depth_sources_are_chosen_or_refused(small):
    assert estimate_depth(unknown(small[:1]), NO_POINTS, options(depth="none"))[0].depth_prior is None
    for source in ("topic", "stereo"):
        with pytest.raises(SequenceError, match=f"depth={source}"):
            estimate_depth(unknown([bare(small[0])]), NO_POINTS, options(depth=source))


def test_a_topic_with_depth_of_few_views_gives_way_to_pairs(small):
    depth_of = lambda count: [frame if i < count else dataclasses.replace(frame, depth=None) for i, frame in enumerate(small[:3])]
    assert [depth_source(depth_of(count), options()) for count in (0, 2, 3)] == ["stereo", "stereo", "topic"]
    lone = [bare(frame, depth=frame.depth) for frame in depth_of(1)]
    assert depth_source(lone, options()) == "topic"


@pytest.mark.slow
def test_each_view_has_its_own_offset_where_it_sees_many_points(large):
    points = triangulate(list(large))
    moved = [dataclasses.replace(f, right=np.ascontiguousarray(np.roll(f.right, -2 - i, axis=1))) for i, f in enumerate(large[:2])]
    offsets = disparity_offsets(moved, [stereo_disparity(frame) for frame in moved], points)
    np.testing.assert_allclose(offsets, [-2, -3], atol=0.3)


@pytest.mark.slow
def test_points_that_a_view_cannot_see_do_not_shift_its_disparities(large):
    points = triangulate(list(large))
    views = [dataclasses.replace(f, right=np.ascontiguousarray(np.roll(f.right, -2, axis=1))) for f in large]
    behind = 2 * points.positions - views[0].camera.position  # at the same pixels of the first view, twice as far away
    both = lambda a, b: np.concatenate([a, a, a, b, b])  # two fifths of what it seems to see is hidden
    known = ScenePoints(both(points.positions, behind), both(points.colors, points.colors), both(*[points.error] * 2))
    offsets = disparity_offsets(views, [stereo_disparity(frame) for frame in views], known)
    np.testing.assert_allclose(offsets, -2, atol=0.3)


@pytest.mark.slow
def test_an_offset_that_no_principal_point_explains_is_refused(large, caplog):
    points = triangulate(list(large))
    far = ScenePoints(2 * points.positions, points.colors, points.error)  # as of poses of twice the scale
    assert (disparity_offsets(list(large), [stereo_disparity(frame) for frame in large], far) == 0).all()
    assert "check poses, their scale and the baseline" in caplog.text


@pytest.mark.slow
def test_small_islands_of_disparity_are_no_surface(large):
    frame = large[0]
    clean = stereo_disparity(frame)
    image, right = frame.image.copy(), frame.right.copy()
    patch = np.random.default_rng(0).integers(0, 255, (20, 20, 3), np.uint8)
    image[200:220, 300:320], right[200:220, 240:260] = patch, patch  # as if 2 cm before the tissue
    disparity = stereo_disparity(dataclasses.replace(frame, image=image, right=right))
    assert (disparity[202:218, 302:318] == 0).mean() > 0.9
    assert (disparity > 0).mean() > (clean > 0).mean() - 0.02


@pytest.mark.slow
def test_depth_between_points_goes_through_those_that_hardly_err(small):
    random, surface = np.random.default_rng(0), lambda uv: 0.08 + 0.01 * np.sin(uv[:, 0] / 30) * np.cos(uv[:, 1] / 30)
    frame, points, _ = _seen_at(small[0], surface, 1500, random)

    def error(point_error):
        depth = interpolate_points(frame, points, options().replaced({"interpolation.point_error": point_error}).interpolation)
        v, u = np.nonzero(depth)
        return np.sqrt(((depth[v, u] / surface(np.column_stack([u, v]) + 0.5) - 1) ** 2).mean())

    assert error(0.0) < 0.7 * error(0.125)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [-3, 2])
def test_a_right_image_that_lies_too_high_or_too_low_is_matched_on_the_rows_of_the_left(large, rows):
    moved = dataclasses.replace(large[0], right=np.roll(large[0].right, rows, axis=0))
    aligned = align_rows(moved)
    assert aligned.right_K[1, 2] - large[0].camera.K[1, 2] == pytest.approx(rows, abs=0.3)
    assert (stereo_disparity(aligned)[60:-60] == stereo_disparity(large[0])[60:-60]).mean() > 0.99
    far = dataclasses.replace(large[0], right=np.roll(large[0].right, 20, axis=0))  # no rectification is that far off
    assert far.right_K is align_rows(far).right_K is None


@pytest.mark.slow
def test_a_tool_is_masked_in_the_right_image_wherever_it_may_be_there(large):
    mask = np.full((512, 640), 255, np.uint8)
    mask[200:300, 300:320] = 0
    hidden = right_view(dataclasses.replace(large[0], mask=mask)).mask == 0
    assert hidden[200:300, 240:320].all() and not hidden[200:300, 320:].any() and not hidden[:200, 100:].any()
