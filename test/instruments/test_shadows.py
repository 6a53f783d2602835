"""Shadows of instruments against what rays from the lamp say, and several pictures at once."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_drawing import CAMERA, cylinder, scene, tissue

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.instruments import Capsule, build_instrument, load_arm
from endo_sim_ros.instruments.drawing import TISSUE, DrawingConfig, InstrumentDrawing

SMALL = Camera(intrinsic_matrix(140, 140, 80, 64), 160, 128)
CAPSULES = {
    "ball": Capsule("roll", np.zeros(3), np.zeros(3), 4e-3),
    "rod": Capsule("roll", np.array([-0.02, 0, 0]), np.array([0.02, 0, 0.005]), 2.5e-3),
    "needle": Capsule("roll", np.array([0.0, -0.02, 0]), np.array([0.0, 0.02, 0]), 0.3e-3),
}


def factors(capsule, at, config, depth=0.1):
    """What drawing a capsule multiplies a plane's linear light with [H, W], NaN where the instrument is seen."""
    pose = np.eye(4)
    pose[:3, 3] = at
    colors, depths, alphas = torch.full((128, 160, 3), 0.5), torch.full((128, 160), depth), torch.ones(128, 160)
    drawing = InstrumentDrawing([[cylinder(1e-4, -1e-4, 1e-4, 16)]], config, "cpu", [[capsule]])
    picture = drawing.draw([{"roll": pose}], SMALL, colors, depths, alphas)
    found = (picture.colors[..., 0] / 0.5).numpy() ** 2
    untouched = (picture.labels == TISSUE) & (picture.depths == depths)
    return np.where(untouched.numpy(), found, np.nan)


def blocked(start, ends, capsule, at):
    """Which of the ways from points [N, 3] to ends [D, 3] a capsule at a place crosses [N, D], by stepping along it."""
    way, hit = ends[None] - start[:, None], np.zeros((len(start), len(ends)), bool)
    axis, length = capsule.end - capsule.start, max(((capsule.end - capsule.start) ** 2).sum(), 1e-20)
    for share in np.linspace(0.22, 0.42, 150):  # of the way to the lamp; the capsules lie there
        beside = start[:, None] + share * way - capsule.start - at
        along = (beside @ axis / length).clip(0, 1)[..., None]
        hit |= ((beside - along * axis) ** 2).sum(-1) < capsule.radius**2
    return hit


def disc(count):
    k = np.arange(count) + 0.5
    angle, radius = np.pi * (1 + 5**0.5) * k, np.sqrt(k / count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CAPSULES)
def test_a_shadow_lies_where_the_lamp_is_hidden(name):
    config = DrawingConfig(ambient=0.0, lamp_x=0.012, lamp_y=-0.006, lamp_size=3e-3)
    at = np.array([0.004, 0.002, 0.07])
    found = factors(CAPSULES[name], at, config)
    points = SMALL.backproject(np.full((128, 160), 0.1))
    lamp = np.array([config.lamp_x, config.lamp_y, 0]) + config.lamp_size * disc(300)
    rng = np.random.default_rng(0)
    rows, columns = np.nonzero(~np.isnan(found))
    dark = np.flatnonzero(found[rows, columns] < 0.99)
    chosen = np.concatenate([rng.choice(dark, min(150, len(dark)), False), rng.choice(len(rows), 60, False)])
    rows, columns = rows[chosen], columns[chosen]
    start = points[rows, columns]
    expected = 1 - blocked(start, lamp, CAPSULES[name], at).mean(1)
    assert len(dark) > 50 and expected.min() < 0.9
    error = np.abs(found[rows, columns] - expected)
    assert error.mean() < 0.015 and np.quantile(error, 0.97) < 0.09 and error.max() < 0.2  # the tip of a needle is not straight


def test_a_small_lamp_makes_sharp_shadows():
    shades = {}
    for size in (0.0, 5e-3):
        found = factors(CAPSULES["ball"], np.array([0.0, 0, 0.06]), DrawingConfig(ambient=0.0, lamp_x=0.02, lamp_size=size))
        shades[size] = ((found > 0.05) & (found < 0.95)).sum()
    assert shades[0.0] < 0.25 * shades[5e-3]


def test_tissue_is_darker_beside_what_touches_it():
    config, long = DrawingConfig(ambient=1.0), Capsule("roll", np.array([-0.3, 0, 0]), np.array([0.3, 0, 0]), 4e-3)
    found = factors(long, np.array([0.0, 0, 0.096]), config)
    y = SMALL.backproject(np.full((128, 160), 0.1))[:, 80, 1]
    expected = 1 - 4e-3**2 / (y**2 + 4e-3**2)  # of an endless rod that lies on a plane: view factor (r / d) cos θ
    near = (np.abs(y) < 0.0155) & ~np.isnan(found[:, 80])
    np.testing.assert_allclose(found[near, 80], expected[near], atol=0.04)
    assert found[64, 20] < 0.1


def both(config=DrawingConfig()):
    """Two instruments with their capsules, and their poses."""
    parts, poses = scene()
    moved = {link: np.array([[1, 0, 0, -0.01], [0, 1, 0, -0.01], [0, 0, 1, -0.015], [0, 0, 0, 1]]) @ pose for link, pose in poses.items()}
    capsules = build_instrument(load_arm("PSM", "LARGE_NEEDLE_DRIVER"))[1]
    return InstrumentDrawing([parts, parts], config, "cpu", [capsules, capsules]), [poses, moved]


def test_an_instrument_shadows_another_but_not_itself():
    with_shadows, poses = both()
    without, _ = both(DrawingConfig(shadows=False))
    pictures = [drawing.draw(poses, CAMERA, *tissue(1.0)) for drawing in (with_shadows, without)]
    darker = (pictures[0].colors < pictures[1].colors - 0.02).any(-1)
    owners = np.array([-1, -1, *(i for i, _ in with_shadows.links)])[pictures[0].labels.numpy()]
    assert not bool((pictures[0].colors > pictures[1].colors + 1e-6).any())
    assert darker.numpy()[owners == 0].sum() > 200 and darker.numpy()[owners == 1].mean() < 0.01  # the second is in front


def test_the_kernels_for_gpus_draw_the_same_picture():
    drawing, poses = both()
    tiles = drawing.draw(poses, CAMERA, *tissue(0.09))
    with compare_plain():
        pixels = drawing.draw(poses, CAMERA, *tissue(0.09))
    for mine, other in zip(vars(tiles).values(), vars(pixels).values()):  # where parts touch, the last bit decides which is seen
        assert (mine != other).float().mean() < 1e-3
    assert (tiles.colors - pixels.colors).abs().max() < 0.1


def test_pictures_drawn_together_are_those_drawn_alone():
    drawing, poses = both()
    aside = replace(CAMERA, pose=np.array([[1.0, 0, 0, 0.005], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    alone = [drawing.draw(poses, camera, *tissue(depth)) for camera, depth in ((CAMERA, 0.09), (aside, 0.08))]
    together = [torch.stack(each) for each in zip(tissue(0.09), tissue(0.08))]
    labels = drawing.draw_into([poses, poses], [CAMERA, aside], *together)
    for i, picture in enumerate(alone):
        assert torch.equal(picture.colors, together[0][i]) and torch.equal(picture.depths, together[1][i])
        assert torch.equal(picture.labels, labels[i])


def test_an_instrument_out_of_sight_changes_nothing():
    drawing, poses = both()
    away = [{link: np.diag([1.0, 1, -1, 1]) @ pose for link, pose in own.items()} for own in poses]
    colors, depths, alphas = tissue(0.09)
    picture = drawing.draw(away, CAMERA, colors, depths, alphas)
    assert torch.equal(picture.colors, colors) and torch.equal(picture.depths, depths) and bool((picture.labels == TISSUE).all())


@pytest.mark.parametrize("absurd", [1e6, 1e30, 1e300, np.nan])
@pytest.mark.parametrize("plain", [False, True])
def test_absurd_poses_change_nothing(absurd, plain):
    drawing, poses = both()
    shift = np.diag([1.0, 1, 1, 1])
    shift[:3, 3] = absurd
    colors, depths, alphas = tissue(0.09)
    with np.errstate(over="ignore"), compare_plain() if plain else contextlib.nullcontext():
        picture = drawing.draw([{link: shift @ pose for link, pose in own.items()} for own in poses], CAMERA, colors, depths, alphas)
    assert torch.equal(picture.colors, colors) and bool((picture.labels == TISSUE).all())


def test_too_many_capsules_are_refused():
    with pytest.raises(ValueError, match="65 capsules throw shadows, and at most 64 can"):
        InstrumentDrawing([[cylinder(1e-3, 0, 0.01)]], device="cpu", capsules=[[CAPSULES["rod"]] * 65])


def test_the_kernels_of_gpus_draw_the_picture_of_those_of_cpus(monkeypatch):
    drawing, poses = both()
    expected = drawing.draw(poses, CAMERA, *tissue(0.09))
    monkeypatch.setenv("ENDO_SIM_THREADS", "1")  # on a CPU these kernels have no atomic operations
    with compare_plain():
        found = drawing.draw(poses, CAMERA, *tissue(0.09))
    assert torch.equal(expected.labels, found.labels)
    assert (expected.colors - found.colors).abs().max() < 1e-4 and (expected.depths - found.depths).abs().max() < 1e-6


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_draws_the_picture_of_the_cpu():
    drawing, poses = both()
    parts, capsules = build_instrument(load_arm("PSM", "LARGE_NEEDLE_DRIVER"))
    on_gpu = InstrumentDrawing([parts, parts], device="cuda", capsules=[capsules, capsules])
    expected = drawing.draw(poses, CAMERA, *tissue(0.09))
    found = on_gpu.draw(poses, CAMERA, *(x.cuda() for x in tissue(0.09)))
    again = on_gpu.draw(poses, CAMERA, *(x.cuda() for x in tissue(0.09)))
    for name, mine in vars(expected).items():
        other = getattr(found, name).cpu()
        far = (mine.float() - other.float()).abs() > 1e-3
        assert far.float().mean() < 2e-3, name
        assert torch.equal(getattr(found, name), getattr(again, name)), name


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_draws_into_the_tensors_that_it_is_given():
    parts, capsules = build_instrument(load_arm("PSM", "LARGE_NEEDLE_DRIVER"))
    make = lambda: InstrumentDrawing([parts, parts], device="cuda", capsules=[capsules, capsules])
    drawing, poses = make(), both()[1]
    first = drawing.draw(poses, CAMERA, *(x.cuda() for x in tissue(0.09)))
    kept = [x.clone() for x in vars(first).values()]
    second = drawing.draw(poses, CAMERA, *(x.cuda() for x in tissue(0.08)))  # the launches are recorded by now
    for mine, before in zip(vars(first).values(), kept):
        assert torch.equal(mine, before)
    for mine, other in zip(vars(second).values(), vars(make().draw(poses, CAMERA, *(x.cuda() for x in tissue(0.08)))).values()):
        assert torch.equal(mine, other)
