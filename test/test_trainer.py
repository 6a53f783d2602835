"""Presets of the trainer, what they are made of, and where reconstruction breaks: a result or one clear error."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from trained import trainer_of

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import features_at
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.reconstruction import ABLATIONS, PRESETS, ReconstructionConfig, losses, preset
from endo_sim_ros.reconstruction.config import GradientConfig, ProximityConfig
from endo_sim_ros.reconstruction.dynamic_mask import without_motion
from endo_sim_ros.reconstruction.presets import resolved
from endo_sim_ros.reconstruction.priors.extrapolation import _continued, with_surroundings
from endo_sim_ros.reconstruction.priors.interpolation import inverse_distance_weighted, kriged
from endo_sim_ros.reconstruction.priors.sources import right_view
from endo_sim_ros.reconstruction.scene import shrink
from endo_sim_ros.reconstruction.strategies import STRATEGIES
from endo_sim_ros.reconstruction.triangulation import match_features, misposed, triangulate
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

SHORT = {"iterations": 12, "max_gaussians": 2000, "refine_every": 5, "device": "cpu"}


def options(**changes):
    return ReconstructionConfig(**(SHORT | changes))


@pytest.fixture(scope="module")
def views():
    """Nine frames 160×128 of half a round about the phantom, the exposure of the camera automatic."""
    return list(phantom_sequence(PhantomConfig(width=160, height=128, frames=9, rounds=0.5, auto_exposure=True, border=0.04)))


@pytest.fixture(scope="module")
def large():
    """Five frames 480×384."""
    return list(phantom_sequence(PhantomConfig(width=480, height=384, frames=5, travel=0.02, stereo=False)))


def bare(frame):
    return dataclasses.replace(frame, depth=None, right=None, baseline=None, right_K=None)


def finite(model: GaussianModel) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in model.tensors().values())


def quality(model, frames) -> tuple[float, float]:
    """Mean PSNR and gain-fitted PSNR, dB."""
    renderer = DeformableRenderer(model, None, RenderingConfig(device="cpu"))
    pairs = [(renderer.render(frame.camera)[0], frame.image, frame.mask) for frame in frames]
    fitted = [metrics.psnr(metrics.gain_fitted(*pair), *pair[1:]) for pair in pairs]
    return float(np.mean([metrics.psnr(*pair) for pair in pairs])), float(np.mean(fitted))


# --------------------------------------------------------------------------------------------- presets


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_trains(views, name):
    points = triangulate(views)[:2]
    model = trainer_of(views[::4], preset(name, **SHORT), points).run()
    assert finite(model) and len(model) <= 2000
    assert (model.light is None) == (name in ("paper", "fsgs", "3dgs"))


def test_options_beside_a_preset_count_and_resolving_twice_changes_nothing():
    config = preset("paper", lambda_tv=0.5, initialization="depth")
    assert (config.initialization, config.lambda_tv, config.light, config.preset) == ("depth", 0.5, False, "default")
    assert resolved(config) == config
    chosen = ReconstructionConfig(preset="3dgs", iterations=7)
    assert resolved(chosen) == preset("3dgs", iterations=7)
    with pytest.raises(ConfigError, match="must be one of"):
        preset("nerf")


def test_every_ablation_changes_its_preset():
    for name, parts in ABLATIONS.items():
        for part, changes in parts.items():
            assert preset(name, **changes) != preset(name), (name, part)


def test_the_default_beats_the_paper_on_two_views(views):
    ends, rest = [views[0], views[-1]], views[1:-1]
    short = {"iterations": 60, "max_gaussians": 6000, "refine_every": 20, "device": "cpu"}
    points = triangulate(views)[:2]
    paper = quality(trainer_of(ends, preset("paper", **short), points).run(), rest)
    ours = quality(trainer_of(ends, preset("default", **short)).run(), rest)
    assert ours[0] > paper[0] + 1.5 and ours[1] > paper[1] + 1.5


# ---------------------------------------------------------------------------------------------- losses


def test_pearson_does_not_see_scale_and_shift():
    depth = torch.rand(20, 30, generator=torch.Generator().manual_seed(0)) + 1
    assert float(losses.pearson(3 * depth + 2, depth, None)) == pytest.approx(0, abs=1e-5)
    assert float(losses.pearson(-depth, depth, None)) == pytest.approx(2, abs=1e-5)
    spoilt = depth.clone()
    spoilt[:10] = 9
    prior = depth.clone()
    prior[:10] = 0  # no measurement
    assert float(losses.pearson(spoilt, prior, None)) == pytest.approx(0, abs=1e-5)


# --------------------------------------------------------------------------------------- densification


def cloud(count: int = 60) -> GaussianModel:
    g = torch.Generator().manual_seed(0)
    return GaussianModel.from_points(torch.rand(count, 3, generator=g), torch.rand(count, 3, generator=g), torch.full((count,), 0.004))


def split_and_clone(model, gradients, limit):
    """What the strategy of 3DGS makes of Gaussians with such mean gradients."""
    state = {"gradients": torch.stack([gradients, torch.ones_like(gradients)])}
    return STRATEGIES["gradient"](GradientConfig(), limit, 1.0).refine(model, state, torch.Generator().manual_seed(0))


def unpool(model, limit):
    return STRATEGIES["proximity"](ProximityConfig(), limit, 1.0).unpool(model)


def test_steep_gaussians_are_split_or_doubled_and_dead_ones_go():
    model = cloud()
    model.logit_opacities[:5] = -9
    model.log_scales[10:15] = np.log(0.05)  # large
    gradients = torch.zeros(60)
    gradients[10:20] = 1.0
    new, source, fresh = split_and_clone(model, gradients, 1000)
    assert len(new) == 60 - 5 + 5 + 5 == len(source) == len(fresh)
    assert not set(range(5)) & set(source.tolist())
    assert sorted(source[fresh].tolist()) == sorted([*range(15, 20), *range(10, 15), *range(10, 15)])
    halves = fresh & (source < 15)
    torch.testing.assert_close(new.log_scales[halves], torch.full((10, 3), np.log(0.05 / 1.6), dtype=torch.float32))
    assert (new.means[halves] != model.means[source[halves]]).any(1).all()
    limited, _, _ = split_and_clone(model, gradients * torch.linspace(1, 2, 60), 58)
    assert len(limited) == 58


def test_exposures_and_colours_do_not_drift_against_each_other(views):
    trainer = trainer_of(views, ReconstructionConfig(iterations=40, max_gaussians=2000, depth="topic", device="cpu"))
    before = trainer._appearance.tensors["exposures"].detach().clone()
    trainer.run()
    after = trainer._appearance.tensors["exposures"].detach()
    assert (after - before).abs().max() > 1e-5
    np.testing.assert_allclose(after.mean(0), before.mean(0), atol=1e-6)


def test_unpooling_fills_gaps_halfway_to_the_neighbours():
    model = cloud()
    model.means[0] = torch.tensor([3.0, 3.0, 3.0])
    new, source, fresh = unpool(model, 1000)
    assert len(new) > 60 and (~fresh).sum() == 60
    added = new.means[fresh]
    assert (added > 1.2).all(1).sum() == 3  # on the way to the lone one
    assert len(unpool(model, 61)[0]) == 61
    assert len(unpool(model, 60)[0]) == 60


# --------------------------------------------------------------------------------------- views and poses


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


@pytest.mark.parametrize("size", [(161, 97), (3840, 2160)])
def test_odd_and_large_pictures_train(size):
    frame = next(iter(phantom_sequence(PhantomConfig(width=160, height=96, frames=1))))
    camera = frame.camera.resized(*size)
    enlarged = lambda image: cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
    large = dataclasses.replace(bare(frame), camera=camera, image=enlarged(frame.image), depth=enlarged(frame.depth), mask=None)
    trainer = trainer_of([large], options(image_width=75, iterations=3))
    assert trainer.cameras[0].width == 75 and finite(trainer.run())


def test_out_of_memory_goes_on_at_half_the_size(views, monkeypatch, caplog):
    trainer = trainer_of(views[::4], options())
    draw, widths = trainer._render, []

    def short_of_memory(viewmats, Ks, size, *arguments):
        widths.append(size[0])
        if size[0] > 80:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return draw(viewmats, Ks, size, *arguments)

    monkeypatch.setattr(trainer, "_render", short_of_memory)
    assert finite(trainer.run()) and trainer.iteration == 12
    assert widths[:2] == [160, 80] and trainer.cameras[0].width == 80
    assert "80 pixels wide" in caplog.text
    tiny = trainer_of([shrink(view, 80) for view in views[::4]], options())
    monkeypatch.setattr(tiny, "_render", lambda *_: (_ for _ in ()).throw(torch.OutOfMemoryError("CUDA out of memory")))
    with pytest.raises(torch.OutOfMemoryError):
        tiny.run()


@pytest.mark.parametrize("name", ["default", "3dgs", "fsgs"])
def test_a_checkpoint_of_any_preset_goes_on_as_if_never_interrupted(views, tmp_path, name):
    make = lambda: trainer_of(views[::4], preset(name, **SHORT), triangulate(views)[:2])
    whole, first = make().run(), make()
    for _ in range(7):
        first.step()
    first.save_checkpoint(tmp_path / "checkpoint.pt")
    second = make()
    second.load_checkpoint(tmp_path / "checkpoint.pt")
    resumed = second.run()
    assert all(torch.equal(a, b) for a, b in zip(resumed.tensors().values(), whole.tensors().values()))
    assert resumed.light == whole.light


# ---------------------------------------------------------------------------------------- surroundings


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
    trainer = trainer_of([known], options(max_gaussians=8000, light=False, exposure=False), (points, np.full((40, 3), 0.5)))
    rendered = DeformableRenderer(trainer.model, None, RenderingConfig(device="cpu")).render(frame.camera)[1]
    plain = trainer_of([known], options(max_gaussians=8000, light=False, exposure=False, extrapolation=0.0)).model
    alone = DeformableRenderer(plain, None, RenderingConfig(device="cpu")).render(frame.camera)[1]
    border = np.ones(exact.shape, bool)
    border[8:-8, 8:-8] = False
    border &= (exact > 0) & (rendered > 0) & (alone > 0) & (True if frame.mask is None else frame.mask > 0)
    assert np.quantile(np.abs(rendered[border] / alone[border] - 1), 0.98) < 0.02


def test_gaussians_around_a_picture_are_small_close_to_it_and_none_is_a_lone_scene_point(views):
    frame = dataclasses.replace(bare(views[4]), depth=views[4].depth)
    K, aside = frame.camera.K, np.array([[230.0, 20.0], [250.0, 60.0], [270.0, 100.0]])  # far beyond the right edge
    local = np.column_stack([(aside - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(3)]) * np.median(frame.depth)
    points = frame.camera.position + local @ frame.camera.pose[:3, :3].T
    model = trainer_of([frame], options(max_gaussians=20_000, light=False, exposure=False), (points, np.full((3, 3), 0.5))).model
    uv, _ = frame.camera.project(model.means.numpy().astype(np.float64))
    out = np.maximum(-uv, uv - [frame.camera.width, frame.camera.height]).max(1)
    sizes = model.scales.numpy().max(1)
    assert sizes[(out > 0) & (out < 12)].max() < 0.75 * np.median(sizes[out > 30])
    assert not (np.abs(model.means.numpy()[:, None] - points).max(2) < 1e-6).any()


def test_noise_of_scene_points_does_not_make_the_tissue_beyond_rough(views):
    frame = dataclasses.replace(bare(views[4]), depth=views[4].depth)
    random, K = np.random.default_rng(0), frame.camera.K
    pixels = random.uniform([170, 0], [200, 128], (400, 2))
    flat = float(np.median(frame.depth[:, -20:]))
    depth = flat * random.normal(1, 0.03, 400)
    local = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]] * depth[:, None], depth])
    points = frame.camera.position + local @ frame.camera.pose[:3, :3].T
    _, continued, *_ = _continued(frame, points, np.zeros(4), np.zeros(3), flat, 48)
    around = continued[48 + 10 : 48 + 118, 48 + 175 : 48 + 195]
    assert np.std(around / flat) < 0.012  # points alone: 0.017


def test_a_picture_goes_on_as_bright_as_it_is_however_far_the_tissue_beyond_is_guessed(views):
    """Tissue that rises towards the right edge and on beyond it; the light falls off with distance."""
    camera, light, exposure = views[4].camera, np.array([0.9, 3.0, 0.1, 0.0]), np.full(3, 0.2)
    depth = (0.1 / np.linspace(1.0, 1.6, 160) * np.ones((128, 1))).astype(np.float32)
    shading = lambda camera, depth: (features_at(camera.backproject(depth).reshape(-1, 3), camera, 0.1) * light).reshape(*depth.shape, 4)
    picture = lambda shaded: 100 * np.exp(shaded.sum(-1) - 0.9 * np.log(1.3))  # of tissue that is of one colour
    image = np.repeat(picture(shading(camera, depth))[..., None], 3, 2).round().astype(np.uint8)
    frame = dataclasses.replace(bare(views[4]), mask=None, image=image, depth=depth)
    wide, continued, colors, _ = _continued(frame, np.empty((0, 3)), light, exposure, 0.1, 48)
    assert continued[48:-48, -10:].max() < 0.95 * depth.min()
    shaded = shading(wide, continued)
    np.testing.assert_allclose(colors[48:-48, 48:-48, 0], colors[64, 64, 0], rtol=0.03)  # in the picture that of the tissue
    without_distance = colors[..., 0] * np.exp(shaded[..., 0])
    np.testing.assert_allclose(without_distance[48:-48, -10:], without_distance[48:-48, -60:-50], rtol=0.05)


@pytest.mark.parametrize(("name", "opaque"), [("default", 0.01), ("paper", 0.0)])
def test_transparency_is_weighed_apart_by_default_and_not_as_printed(views, monkeypatch, name, opaque):
    weights = []
    monkeypatch.setattr(losses, "depth_l1", lambda *arguments: weights.append(arguments[-1]) or torch.zeros(()))
    trainer_of(views[:3], preset(name, **SHORT)).step()
    assert weights == [opaque]


def test_depth_beyond_is_that_of_kriging():
    random, width = np.random.default_rng(0), 80  # one pixel a cell
    known = np.zeros((12, width), bool)
    known[2:6, 3:8] = True
    values, uv, there = random.normal(0, 1, known.shape), random.uniform(0, [width, 12], (15, 2)), random.normal(0, 1, 15)
    told = kriged(values, known, uv, there, width)
    assert (told[known] == values[known]).all()
    rows, columns = np.nonzero(known)
    sources = np.concatenate([np.column_stack([columns, rows]) + 0.5, uv])
    rows, columns = np.nonzero(~known)
    targets = np.column_stack([columns, rows]) + 0.5
    # Half the squared difference of what lies a distance apart is that distance, to which the variances of the sources come.
    between = lambda a, b: -np.linalg.norm(a[:, None] - b, axis=2)
    system = np.zeros((36, 36))
    system[:35, :35] = between(sources, sources) + np.diag(np.repeat([width / 128, width / 8], [20, 15]))
    system[35, :35] = system[:35, 35] = 1
    weights = np.linalg.solve(system, np.column_stack([between(targets, sources), np.ones(len(targets))]).T)[:35]
    expected = weights.T @ np.concatenate([values[known], there])
    np.testing.assert_allclose(told[~known], expected, atol=1e-4)


def test_colour_beyond_is_the_mean_of_what_is_seen_by_distance():
    random, width = np.random.default_rng(0), 80  # one pixel a cell
    known = random.random((12, width)) < 0.2
    values = random.random((*known.shape, 3))
    carried = inverse_distance_weighted(values, known, width)
    assert (carried[known] == values[known]).all()
    distance = np.linalg.norm(np.argwhere(~known)[:, None] - np.argwhere(known), axis=2)
    weights = 1 / (distance**2 + 0.25) ** 2
    expected = weights @ values[known] / weights.sum(1, keepdims=True)
    np.testing.assert_allclose(carried[~known], expected, atol=1e-5)


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
        around = with_surroundings(nothing, pair, np.zeros(4), np.zeros((2, 3)), 0.1, np.empty((0, 3)), 0.9, 60_000)
        (u, v), colors = left.camera.project(around.means.numpy().astype(np.float64))[0].T, around.sh[:, 0].numpy()
        beside = (v > 0) & (v < 128)
        for where, nearer, farther in (((u > 250) & beside, 1, 0), ((u < -10) & beside, 0, 1)):
            assert where.sum() > 20 and (colors[where, nearer] > colors[where, farther]).all()


def test_tissue_goes_on_beyond_the_pictures_and_in_holes(views):
    frame = dataclasses.replace(bare(views[4]), depth=views[4].depth.copy())
    frame.depth[50:80, 60:100] = 0  # as at a glint
    known = trainer_of([frame], options(max_gaussians=4000, extrapolation=0.0)).model
    wider = trainer_of([frame], options(max_gaussians=4000, extrapolation=0.3))
    camera = dataclasses.replace(frame.camera, K=frame.camera.K + np.array([[0, 0, 40], [0, 0, 30], [0, 0, 0]]), width=240, height=188)
    renderer = lambda model: DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(camera)[1]
    before, after = renderer(known), renderer(wider.model)
    assert (before > 0).mean() < 0.6 and (after > 0).mean() > 0.95
    hole = after[30 + 55 : 30 + 75, 40 + 65 : 40 + 95]
    exact = views[4].depth[55:75, 65:95]
    assert np.median(np.abs(hole / exact - 1)) < 0.03
