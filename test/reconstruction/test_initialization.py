"""The initial model: on the surface, within limits, without what floats."""

import dataclasses

import numpy as np
import pytest
from short_training import NO_POINTS
from training_views import with_prior

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.reconstruction.initialization import initial_model
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.surfaces import Surfaces

TOLERANCE = 0.05


def placed(frames, count=2000, points=NO_POINTS.positions):
    """The initial model of frames by their depth, and grey points."""
    return initial_model(with_prior(frames), points, np.full(points.shape, 0.5), TOLERANCE, count)


def test_initial_model_lies_on_the_surface_within_the_limit(small):
    model = placed(small[::4], 3000)
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
    model = placed([dataclasses.replace(first, depth=depth), second], 50_000)
    uv, z = second.camera.project(model.means.numpy().astype(np.float64))
    u, v = np.floor(uv).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < 160) & (v < 128)
    assert (z[inside] > 0.94 * second.depth[v[inside], u[inside]]).all()
    alone = placed([dataclasses.replace(first, depth=depth)], 50_000)
    assert float(alone.means[:, 2].min()) < 0.7 * first.depth.min() + first.camera.position[2]


def test_masked_pixels_give_no_gaussians(small):
    mask = np.zeros_like(small[0].mask)
    mask[:, :80] = 255
    model = placed([dataclasses.replace(small[0], mask=mask)])
    uv, _ = small[0].camera.project(model.means.numpy().astype(np.float64))
    assert uv[:, 0].max() < 80


def highlight(frame):
    """The frame with a hole of the depth in the middle, as highlights make, and a function from distance (of the tissue's) to two points
    there and two at its side, where depth is known."""
    depth, (height, width) = frame.depth.copy(), frame.depth.shape
    row, column = height // 2, width // 2
    pixels = [(row, column), (row, column - 30)]
    depth[row - 10 : row + 11, column - 10 : column + 11] = 0
    camera, rays = frame.camera, frame.camera.backproject(np.ones_like(depth)) - frame.camera.position

    def at(distance):
        points = np.array([camera.position + rays[pixel] * distance * float(frame.depth[pixel]) for pixel in pixels])
        return np.concatenate([points, points + 1e-4])

    return dataclasses.replace(frame, depth=depth), at


def among(model, points):
    """Which of the points are Gaussians."""
    return np.linalg.norm(model.means.double().numpy()[:, None] - points, axis=2).min(0) < 1e-6


def test_points_become_gaussians_where_they_neither_float_before_the_surface_nor_sink_behind_it(small):
    frame, at = highlight(small[0])
    for distance, in_hole in ((0.5, False), (0.98, True), (1.02, True), (1.1, True), (2.0, False)):
        points = at(distance)
        assert among(placed([frame], 50_000, points), points).tolist() == [in_hole, False] * 2, distance


def test_a_point_behind_what_one_view_sees_may_be_what_another_one_sees_in_a_hole(small):
    frame, at = highlight(small[0])
    points = at(1.0)[[0, 2]]
    hiding = dataclasses.replace(small[0], depth=0.7 * small[0].depth)  # of another surface, before it
    assert not among(placed([hiding], 50_000, points), points).any()
    assert among(placed([frame, hiding], 50_000, points), points).all()
    blind = dataclasses.replace(small[0], depth=np.zeros_like(frame.depth))  # knows no depth, and says nothing against them
    assert among(placed([blind, hiding], 50_000, points), points).all()


def test_the_colours_are_the_mean_of_the_views_that_see_the_surface(small):
    dark = dataclasses.replace(small[0], image=small[0].image // 2)
    alone, both = (placed(frames, 3000).base_colors.mean() for frames in ([small[0]], [small[0], dark]))
    assert float(both / alone) == pytest.approx(0.75, abs=0.02)


def test_too_few_points_are_one_clear_error(small):
    empty = dataclasses.replace(small[0], depth=np.zeros_like(small[0].depth))
    with pytest.raises(SequenceError, match="only 9 scene points could be found in 1 view; give depth"):
        placed([empty], points=np.random.default_rng(0).random((9, 3)))
    assert len(placed([empty], points=np.random.default_rng(0).random((10, 3)))) == 10


def test_a_limit_that_leaves_next_to_nothing_is_named(small):
    points = np.empty((0, 3))
    for share, most in ((1.0, 3), (0.5, 7)):
        with pytest.raises(SequenceError, match=rf"max_gaussians = {most} is too small: of \d+ pixels with depth in 1 view it leaves \d "):
            initial_model(with_prior(small[:1]), points, points, TOLERANCE, most, share=share)


@pytest.mark.slow
def test_surfaces_are_compared_as_by_plain_numpy(small):
    random = np.random.default_rng(0)
    noisy = lambda depth: (depth * random.normal(1, 0.03, depth.shape)).astype(np.float32)
    views, tolerance = with_prior([dataclasses.replace(frame, depth=noisy(frame.depth)) for frame in small[::3]]), TOLERANCE
    surfaces = Surfaces(views, "cpu")
    chosen = surfaces.chosen(tolerance, StageProgress())
    colors = surfaces.mean_colors(chosen, tolerance, StageProgress())
    finest = np.argsort([np.median(view.surface[view.surface > 0]) for view in views], kind="stable").tolist()
    for i, view in enumerate(views):
        known = (view.surface > 0) & (view.tissue > 0)
        points = view.camera.backproject(view.surface.astype(np.float64))
        kept, total, count = known.copy(), view.image / 255.0, np.ones((*known.shape, 1))
        for j, other in enumerate(views):
            if i == j:
                continue
            uv, z = other.camera.project(points.reshape(-1, 3))
            inside = other.camera.sees(points.reshape(-1, 3))
            u, v = np.where(inside, np.floor(uv).astype(int).T, 0)
            surface = np.where(inside, other.surface[v, u], 0).reshape(known.shape)
            z, before = z.reshape(known.shape), finest.index(j) < finest.index(i)
            kept &= (surface <= 0) | (z >= surface * (1 + tolerance if before else 1 - tolerance))
            agrees = ((surface > 0) & (np.abs(z - surface) < tolerance * surface))[..., None]
            total, count = total + agrees * (other.image[v, u] / 255.0).reshape(*known.shape, 3), count + agrees
        assert 0 < kept.sum() < known.sum() or i == finest[0]
        assert (kept != chosen[i]).mean() < 1e-3  # at the edges of pixels float32 rounds otherwise
        off = np.abs(colors[i] - (total / count)[chosen[i]]).max(1)
        assert (off > 1e-5).mean() < 1e-3
