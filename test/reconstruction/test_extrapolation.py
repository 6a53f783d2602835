"""Tissue beyond the pictures and in holes."""

import dataclasses
import math
import re

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from short_training import bare, film, options, options_of_depth
from training_views import with_prior

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import features_at
from endo_sim_ros.reconstruction import prepare
from endo_sim_ros.reconstruction.priors.extrapolation import SeenTissue, _spread_evenly, brightness_ratio, continue_view, extrapolate
from endo_sim_ros.reconstruction.priors.nearness import log_nearness
from endo_sim_ros.reconstruction.stage_configs import ExtrapolationConfig, MatchingConfig
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig


def initial(frame, points=None, **changes):
    """What a training of one view starts from, without light, and with grey scene points [N, 3]."""
    points = None if points is None else (points, np.full((len(points), 3), 0.5))
    return prepare([frame], options_of_depth(max_gaussians=8000, light=False, exposure=False, **changes), points).model


@pytest.mark.slow
def test_what_goes_on_beyond_a_picture_does_not_reach_into_it(views):
    frame = bare(views[4])
    exact, pixels = views[4].depth, np.column_stack([np.full(40, 175.0), np.linspace(5, 120, 40)])
    known = dataclasses.replace(frame, depth=exact)
    # Tissue that other views saw, beyond the right edge, and one point before it that is none.
    K = frame.camera.K
    depth = np.full(40, np.median(exact))
    depth[20] *= 0.6
    local = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]] * depth[:, None], depth])
    points = frame.camera.position + local @ frame.camera.pose[:3, :3].T
    depth_of = lambda model: DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(frame.camera)[1]
    rendered, alone = depth_of(initial(known, points)), depth_of(initial(known, extrapolation=0.0))
    border = np.ones(exact.shape, bool)
    border[8:-8, 8:-8] = False
    border &= (exact > 0) & (rendered > 0) & (alone > 0) & (True if frame.mask is None else frame.mask > 0)
    assert np.quantile(np.abs(rendered[border] / alone[border] - 1), 0.98) < 0.02


@pytest.mark.slow
def test_gaussians_around_a_picture_are_small_close_to_it_and_none_is_a_lone_scene_point(views):
    frame = dataclasses.replace(bare(views[4]), depth=views[4].depth)
    K, aside = frame.camera.K, np.array([[230.0, 20.0], [250.0, 60.0], [270.0, 100.0]])  # far beyond the right edge
    local = np.column_stack([(aside - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(3)]) * np.median(frame.depth)
    points = frame.camera.position + local @ frame.camera.pose[:3, :3].T
    config = options_of_depth(max_gaussians=20_000, light=False, exposure=False)
    model = prepare([frame], config, (points, np.full((3, 3), 0.5))).model
    uv, _ = frame.camera.project(model.means.numpy().astype(np.float64))
    out = np.maximum(-uv, uv - [frame.camera.width, frame.camera.height]).max(1)
    sizes = model.scales.numpy().max(1)
    assert sizes[(out > 0) & (out < 12)].max() < 0.75 * np.median(sizes[out > 30])
    assert not (np.abs(model.means.numpy()[:, None] - points).max(2) < 1e-6).any()


@pytest.mark.slow
def test_noise_of_scene_points_does_not_make_the_tissue_beyond_rough(views):
    (frame,) = with_prior(views[4:5])
    random, K = np.random.default_rng(0), frame.camera.K
    pixels = random.uniform([170, 0], [200, 128], (400, 2))
    flat = float(np.median(frame.depth_prior[:, -20:]))
    depth = flat * random.normal(1, 0.03, 400)
    local = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]] * depth[:, None], depth])
    points = frame.camera.position + local @ frame.camera.pose[:3, :3].T
    continued = continue_view(frame, torch.from_numpy(points), np.zeros(4), np.zeros(3), flat, 48)
    around = continued.depth[48 + 10 : 48 + 118, 48 + 175 : 48 + 195]
    assert np.std(around / flat) < 0.012  # points alone: 0.017


@pytest.mark.slow
def test_many_noisy_points_do_not_pull_the_tissue_beyond_towards_the_camera(views):
    """Dozens in every pixel beyond the right edge of a flat picture, each 2 % off."""
    camera, random = views[4].camera, np.random.default_rng(0)
    flat = np.full((camera.height, camera.width), 0.1, np.float32)
    (frame,) = with_prior([dataclasses.replace(bare(views[4]), mask=None, depth=flat)])
    pixels, depth = random.uniform([165, 0], [200, 128], (100_000, 2)), 0.1 * random.normal(1, 0.02, 100_000)
    points = torch.from_numpy(camera.unproject(pixels, depth))
    continued = continue_view(frame, points, np.zeros(4), np.zeros(3), 0.1, 48)
    assert abs(continued.depth[48 + 10 : 48 + 118, 48 + 170 : 48 + 195].mean() / 0.1 - 1) < 2e-3


@pytest.mark.slow
def test_a_picture_goes_on_as_bright_as_it_is_however_far_the_tissue_beyond_is_guessed(views):
    """Tissue that rises towards the right edge and on beyond it; the light falls off with distance."""
    camera, light, exposure = views[4].camera, np.array([0.9, 3.0, 0.1, 0.0]), np.full(3, 0.2)
    depth = (0.1 / np.linspace(1.0, 1.6, 160) * np.ones((128, 1))).astype(np.float32)
    shading = lambda camera, depth: (features_at(camera.backproject(depth).reshape(-1, 3), camera, 0.1) * light).reshape(*depth.shape, 4)
    picture = lambda shaded: 100 * np.exp(shaded.sum(-1) - 0.9 * np.log(1.3))  # of tissue that is of one colour
    image = np.repeat(picture(shading(camera, depth))[..., None], 3, 2).round().astype(np.uint8)
    (view,) = with_prior([dataclasses.replace(bare(views[4]), mask=None, image=image, depth=depth)])
    wide, continued, colors, _ = continue_view(view, torch.empty(0, 3, dtype=torch.float64), light, exposure, 0.1, 48)
    assert continued[48:-48, -10:].max() < 0.95 * depth.min()
    shaded = shading(wide, continued)
    np.testing.assert_allclose(colors[48:-48, 48:-48, 0], colors[64, 64, 0], rtol=0.03)  # in the picture that of the tissue
    without_distance = colors[..., 0] * np.exp(shaded[..., 0])
    np.testing.assert_allclose(without_distance[48:-48, -10:], without_distance[48:-48, -60:-50], rtol=0.05)


def in_no_light(model, views):
    """What views saw that share no scene points."""
    return SeenTissue(model, views, np.empty((0, 3)), np.zeros(4), np.zeros((len(views), 3)), 0.1)


LIGHT = np.array([0.9, 2.0, 0.0, 0.0])


def lit(frame, depth, colour):
    """The view with that depth [H, W] (m) as its prior, and the picture of tissue of a colour [H, W] in [0, 1] in `LIGHT`."""
    shading = features_at(frame.camera.backproject(depth).reshape(-1, 3), frame.camera, 0.05) @ LIGHT
    image = np.repeat((255 * colour * np.exp(shading).reshape(depth.shape)).clip(0, 255)[..., None], 3, 2).round().astype(np.uint8)
    return with_prior([dataclasses.replace(bare(frame), mask=None, image=image, depth=depth.astype(np.float32))])[0]


def mottles(shape, spread, size):
    """Colours [H, W] that vary by so much, in patches of so many pixels."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=shape), (0, 0), size)
    return 0.4 * np.exp(spread * noise / noise.std())


def judged(frames, depths, colours, known, options=ExtrapolationConfig()):
    """What `brightness_ratio` says of views of depths [H, W] that are known [H, W] in part, and points there."""
    views = [lit(*each) for each in zip(frames, depths, colours)]
    points = np.concatenate([view.camera.backproject(view.depth_prior)[where] for view, where in zip(views, known)])
    views = [dataclasses.replace(view, depth_prior=np.where(where, view.depth_prior, 0)) for view, where in zip(views, known)]
    nothing = GaussianModel.from_points(torch.zeros(1, 3), torch.zeros(1, 3), torch.full((1,), 1e-6), 0.5)
    return views, points, brightness_ratio(SeenTissue(nothing, views, points, LIGHT, np.zeros((len(views), 3)), 0.05, options))


def test_brightness_tells_depth_along_a_tube_where_no_point_does(views):
    """Known is a ring of it half-way down; the second view is farther in."""
    frame = views[4]
    ahead = frame.camera.pose.copy()
    ahead[:3, 3] += 0.008 * ahead[:3, 2]
    x, y = frame.camera.rays()[..., :2].transpose(2, 0, 1)
    depth = np.minimum(0.02 / np.hypot(x, y), 0.1)
    # Colours belong to the wall, at angles and depths in the tube.
    angle, depths = np.arctan2(y, x), (depth, np.minimum(depth, 0.092))
    colours = [0.3 * np.exp(0.05 * np.sin(9 * angle + along / 0.002)) for along in (depths[0], depths[1] + 0.008)]
    known = [(each > 0.045) & (each < 0.08) for each in depths]
    told, points, ratio = judged([frame, dataclasses.replace(frame, camera=frame.camera.at(ahead))], depths, colours, known)
    assert ratio < 0.8
    near, view = log_nearness(told[0], LIGHT, np.zeros(3), 0.05, 0.02), told[0]
    continued = lambda near: continue_view(view, torch.from_numpy(points), LIGHT, np.zeros(3), 0.05, 8, near).depth[8:-8, 8:-8]
    error = lambda near: np.abs(continued(near) / depth - 1)[depth < 0.045].mean()  # walls nearer than all that is known
    assert error(near) < 0.08 and error(None) > 0.15


def test_mottled_tissue_does_not_let_brightness_tell_depth(views):
    """A level sheet with a hole in what is known, of which a second view from aside shows the same colours."""
    frame, shift = views[4], 20  # pixels
    aside = frame.camera.pose.copy()
    aside[:3, 3] += shift * 0.1 / frame.camera.K[0, 0] * aside[:3, 0]
    wide = mottles((frame.camera.height, frame.camera.width + shift), 0.3, 8)
    colours, flat = (wide[:, :-shift], wide[:, shift:]), np.full((frame.camera.height, frame.camera.width), 0.1)
    known = np.ones(flat.shape, bool)
    known[30:100, 40:120] = False
    frames = [frame, dataclasses.replace(frame, camera=frame.camera.at(aside))]
    assert judged(frames, (flat, flat), colours, (known, known))[2] > 1.2


def test_brightness_tells_no_depth_where_little_of_it_lacks(views):
    """Of a level sheet, a hole of a sixteenth: rims and glints are no more."""
    frame, shift = views[4], 20  # pixels
    aside = frame.camera.pose.copy()
    aside[:3, 3] += shift * 0.1 / frame.camera.K[0, 0] * aside[:3, 0]
    wide, flat = mottles((frame.camera.height, frame.camera.width + shift), 0.3, 8), np.full((frame.camera.height, frame.camera.width), 0.1)
    known = np.ones(flat.shape, bool)
    known[50:82, 60:100] = False
    seen = (
        [frame, dataclasses.replace(frame, camera=frame.camera.at(aside))],
        (flat, flat),
        (wide[:, :-shift], wide[:, shift:]),
        (known, known),
    )
    assert math.isinf(judged(*seen)[2]) and math.isfinite(judged(*seen, ExtrapolationConfig(brightness_holes=0.05))[2])


@pytest.mark.thorough
def test_light_that_known_depth_makes_seem_true_is_judged_by_all_that_views_see(views):
    """A level sheet in even light, darker away from a middle column up to its edge. Of it alone depth is known, and half of what it is."""
    frame, shift = views[4], 16  # pixels
    height, width = frame.camera.height, frame.camera.width
    aside = frame.camera.pose.copy()
    aside[:3, 3] += shift * 0.1 / frame.camera.K[0, 0] * aside[:3, 0]
    across = np.abs(np.arange(width + shift) - (width + shift) / 2) / frame.camera.K[0, 0]
    sheet = np.tile(180 * np.exp(-6 * np.minimum(across, 0.15) ** 2), (height, 1))
    known = np.zeros((height, width), np.float32)
    known[:, width // 2 - 20 : width // 2 + 20] = 0.05
    picture = lambda grey: np.repeat(grey[..., None], 3, 2).round().astype(np.uint8)
    frames = [
        dataclasses.replace(bare(frame), mask=None, image=picture(grey), camera=frame.camera.at(pose), depth=known)
        for grey, pose in ((sheet[:, :-shift], frame.camera.pose), (sheet[:, shift:], aside))
    ]
    scene = prepare(frames, options_of_depth(max_gaussians=8000))
    (told,) = [sentence for sentence in scene.decisions if "times as much in colour as in none" in sentence]
    assert told.startswith("training starts without light")
    assert np.abs(scene.light).max() < 1e-4


@pytest.mark.thorough
def test_no_lamp_stands_farther_aside_than_the_tissue_is_away_where_no_scene_point_tells_depth(views):
    """Brightness grows along a level sheet and moves with the camera, whose exposure is fixed."""
    frame, lamps = bare(views[4]), ((1.5, False, False), (0.4, False, True), (1.5, True, True))  # tilt, whether points tell depth, taken
    height, width = frame.camera.height, frame.camera.width
    slopes = frame.camera.rays()[..., 0] / frame.camera.rays()[..., 2]
    for tilt, pointed, taken in lamps:
        frames = []
        for shift in (0, 16, 32):  # pixels
            pose = frame.camera.pose.copy()
            pose[:3, 3] += shift * 0.1 / frame.camera.K[0, 0] * pose[:3, 0]
            grey = (mottles((height, width + 32), 0.1, 3)[:, shift : shift + width] * 200 * np.exp(tilt * slopes)).clip(0, 255)
            image = np.repeat(grey[..., None], 3, 2).round().astype(np.uint8)
            frames.append(dataclasses.replace(frame, mask=None, image=image, camera=frame.camera.at(pose), depth=None))
        matching = MatchingConfig() if pointed else MatchingConfig(min_points=10_000)
        scene = prepare(frames, options(max_gaussians=4000, extrapolation=0.0, exposure=False, matching=matching))
        assert any("farther aside" in sentence for sentence in scene.decisions) != taken, (scene.light, scene.decisions)
        assert (np.abs(scene.light).max() > 0.1) == taken
        kept = r"training starts with the light as it was fitted: in it, views differ (\d\.\d\d) times as much in colour as in none"
        ratios = [float(match[1]) for sentence in scene.decisions if (match := re.fullmatch(kept, sentence))]
        assert len(ratios) == taken and all(ratio <= 1 for ratio in ratios), scene.decisions


@pytest.mark.thorough
@pytest.mark.slow
def test_what_lies_beyond_two_views_looks_as_in_the_nearer_one(views):
    """Whichever of them comes first."""
    frame = dataclasses.replace(bare(views[4]), mask=None, depth=np.full((128, 160), 0.1, np.float32))
    # A view to the right of it, overlapping by half, green instead of red.
    pose = frame.camera.pose.copy()
    pose[:3, 3] += pose[:3, 0] * 80 * 0.1 / frame.camera.K[0, 0]
    red, green = (np.full((128, 160, 3), color, np.uint8) for color in ((200, 0, 0), (0, 200, 0)))
    left = dataclasses.replace(frame, image=red)
    right = dataclasses.replace(frame, image=green, camera=frame.camera.at(pose))
    nothing = GaussianModel.from_points(torch.zeros(1, 3), torch.zeros(1, 3), torch.full((1,), 1e-6), 0.5)
    for pair in ([left, right], [right, left]):
        around = extrapolate(in_no_light(nothing, with_prior(pair)), 0.9, 60_000)
        (u, v), colors = left.camera.project(around.means.numpy().astype(np.float64))[0].T, around.sh[:, 0].numpy()
        beside = (v > 0) & (v < 128)
        for where, nearer, farther in (((u > 250) & beside, 1, 0), ((u < -10) & beside, 0, 1)):
            assert where.sum() > 20 and (colors[where, nearer] > colors[where, farther]).all()


@pytest.mark.slow
def test_tissue_goes_on_beyond_the_pictures_and_in_holes(views):
    frame = dataclasses.replace(bare(views[4]), depth=views[4].depth.copy())
    frame.depth[50:80, 60:100] = 0  # as at a glint
    known, wider = (prepare([frame], options_of_depth(max_gaussians=4000, extrapolation=reach)).model for reach in (0.0, 0.3))
    camera = dataclasses.replace(frame.camera, K=frame.camera.K + np.array([[0, 0, 40], [0, 0, 30], [0, 0, 0]]), width=240, height=188)
    renderer = lambda model: DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(camera)[1]
    before, after = renderer(known), renderer(wider)
    assert (before > 0).mean() < 0.6 and (after > 0).mean() > 0.95
    hole = after[30 + 55 : 30 + 75, 40 + 65 : 40 + 95]
    exact = views[4].depth[55:75, 65:95]
    assert np.median(np.abs(hole / exact - 1)) < 0.03


@pytest.mark.slow
def test_no_more_gaussians_than_asked_for_and_larger_ones_instead(views):
    (view,) = with_prior(views[4:5])
    nothing = GaussianModel.from_points(torch.zeros(1, 3), torch.zeros(1, 3), torch.full((1,), 1e-6), 0.5)
    around = lambda most: extrapolate(in_no_light(nothing, [view]), 0.3, most)
    many, few = around(60_000), around(201)
    assert len(few) == 201 < len(many)
    assert few.scales[1:].median() > 1.5 * many.scales[1:].median()
    assert len(around(1)) == 1


@pytest.mark.parametrize("room", [60, 700, 1500, 2300])
def test_those_for_which_there_is_room_leave_no_rows_between_them(room):
    """Uneven lattices of two views: from any place the nearest one that is kept is within 1.5 times the mean distance."""
    rng = np.random.default_rng(0)
    lattice = np.stack(np.meshgrid(np.arange(40.0), np.arange(30.0), [0.0]), -1).reshape(-1, 3)
    positions = np.concatenate([lattice, lattice + [60.3, 4.7, 0]]) + rng.normal(0, 0.05, (2400, 3))
    kept, times = _spread_evenly(positions, np.ones(len(positions)), room)
    assert len(np.unique(kept)) == room
    tree = KDTree(positions[kept])
    apart = (len(positions) / room) ** 0.5
    assert tree.query(positions)[0].max() < 1.5 * apart and 0.9 * apart < times < 2.1 * apart


def test_a_lattice_and_a_line_leave_no_room_unused():
    lattice = np.stack(np.meshgrid(np.arange(40.0), np.arange(30.0), [0.0]), -1).reshape(-1, 3)
    for positions, room in ((lattice, 1199), (lattice, 300), (lattice[:40], 7), (np.arange(1200.0)[:, None] * [1, 0, 0], 100)):
        kept = _spread_evenly(positions, np.ones(len(positions)), room)[0]
        assert len(np.unique(kept)) == room
        assert KDTree(positions[kept]).query(positions)[0].max() <= max(1.5 * (len(positions) / room) ** 0.5, 0.6 * len(positions) / room)


def test_without_reach_nothing_is_added(views):
    nothing = GaussianModel.from_points(torch.zeros(1, 3), torch.zeros(1, 3), torch.full((1,), 1e-6), 0.5)
    assert extrapolate(in_no_light(nothing, with_prior(views[4:5])), 0.0, 60_000) is nothing


def test_a_view_that_knows_next_to_no_depth_tells_nothing_of_its_surroundings(views):
    depth = np.zeros_like(views[4].depth)
    depth[60:62, 80:90] = views[4].depth[60:62, 80:90]
    seen = with_prior([dataclasses.replace(views[4], depth=depth), bare(views[0])])
    nothing = GaussianModel.from_points(torch.zeros(1, 3), torch.zeros(1, 3), torch.full((1,), 1e-6), 0.5)
    assert extrapolate(in_no_light(nothing, seen), 0.3, 60_000) is nothing


@pytest.mark.parametrize("known", [np.s_[20:21], np.s_[:, 20:21]])
def test_depth_in_one_line_is_continued_level_to_its_sides(known):
    """Of how depth changes across the line nothing is known."""
    (frame,) = film(40, 40, 1)
    line = np.zeros_like(frame.depth)
    line[known] = frame.depth[known]
    model = prepare([dataclasses.replace(bare(frame), depth=line)], options_of_depth(depth="topic")).model
    _, depth = frame.camera.project(model.means.numpy())
    assert len(model) > 100 and 0.7 * line[known].min() < depth.min() and depth.max() < 1.4 * line.max()
