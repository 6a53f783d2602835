"""What an open cut shows: the flesh below the skin."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import softplus

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.core.gaussians import GLOSS_FIELDS, SH_C0, GaussianModel
from endo_sim_ros.core.light import Light
from endo_sim_ros.physics.cutting.geometry import sweep
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.rendering.config import InsideConfig
from endo_sim_ros.rendering.inside import Inside, OrganColors

CAMERA = Camera(np.array([[120.0, 0, 48], [0, 120, 40], [0, 0, 1]]), 96, 80)
SKIN, BACK, MIDDLE = 0.1, 0.115, 0.0003  # m: depth of the skin and of the back, x of the cut
OPENED = 0.003  # m by which each side of the skin is pulled away
DARK, FLESH = InsideConfig(shown=False), InsideConfig()


def skin(gloss=False, rough=1e-5):
    g = torch.Generator().manual_seed(0)
    points = torch.cat([torch.rand(6000, 2, generator=g) * 0.1 - 0.05, SKIN + rough * torch.rand(6000, 1, generator=g)], 1)
    colors = torch.tensor([0.8, 0.5, 0.5]) + 0.1 * torch.rand(6000, 3, generator=g)
    model = GaussianModel.from_points(points, colors, torch.full((6000,), 1e-3), 0.95)
    if gloss:
        rows = torch.randn(6000, len(GLOSS_FIELDS), generator=g)
        model = dataclasses.replace(model, gloss=rows, light=Light(sheen_sharpness=3.0, glint_sharpness=40.0, facing=0.5))
    return model


def nodes():
    """Of a block, 5 mm apart."""
    x, y = np.meshgrid(np.arange(-10, 11) * 0.005, np.arange(-10, 11) * 0.005)
    return np.concatenate([np.stack([x, y, np.full_like(x, SKIN + 0.005 * k)], -1).reshape(-1, 3) for k in range(4)])


def opened(rest):
    """Positions and F of nodes whose two sides are pulled apart at the skin and hang together at the back."""
    side = np.where(rest[:, 0] > MIDDLE, OPENED, -OPENED)
    F = np.tile(np.eye(3), (len(rest), 1, 1))
    F[:, 0, 2] = -side / (BACK - SKIN)
    return rest + np.stack([side * (BACK - rest[:, 2]) / (BACK - SKIN), 0 * side, 0 * side], 1), F


def cut(to=0.06):
    """Right through, along y from one border on, in steps of 4 mm."""
    at = np.arange(-0.06, to + 1e-9, 0.004)
    edge = lambda y: np.stack([np.full(5, MIDDLE), np.full(5, y), np.linspace(SKIN - 0.005, BACK + 0.005, 5)], 1)
    return np.concatenate([sweep(edge(a), edge(b)) for a, b in zip(at[:-1], at[1:])])


def renderer(inside=FLESH, model=None, rest=None, triangles=None):
    made = DeformableRenderer(model or skin(), nodes() if rest is None else rest, RenderingConfig(device="cpu", inside=inside))
    if triangles is not None:
        made.cut(triangles)
    return made


def test_an_open_cut_shows_flesh_and_no_darkness():
    state = opened(nodes())
    dark, flesh = (renderer(inside, triangles=cut()).views([CAMERA], *state, labels=True)[0] for inside in (DARK, FLESH))
    opening = dark.labels == 0
    assert opening.sum() > 300
    assert (flesh.labels[opening] == 0).sum() == 0
    red, green, blue = flesh.image[opening].astype(float).T
    assert np.median(red) > 60 and (red > 1.3 * green).mean() > 0.9 and (red > 1.3 * blue).mean() > 0.9
    whole = np.abs(flesh.image.astype(int) - dark.image).max(2)
    away = np.abs(np.arange(96) + 0.5 - 48 - 120 * MIDDLE / SKIN) > 120 * (OPENED + 0.004) / SKIN
    assert not whole[:, away].any()  # nothing of the inside is seen through the skin


def test_flesh_does_not_show_through_uneven_skin():
    uneven, state = skin(rough=0.003), opened(nodes())
    insides = DARK, InsideConfig(blood=0.0)  # blood lies on the skin
    dark, flesh = (renderer(inside, uneven, triangles=cut()).views([CAMERA], *state, labels=True)[0] for inside in insides)
    covered = cv2.erode((dark.labels == 1).astype(np.uint8), np.ones((3, 3))) > 0
    assert (np.abs(flesh.image.astype(int) - dark.image).max(2)[covered] > 24).sum() < 5
    assert (flesh.labels[dark.labels == 0] == 0).mean() < 0.01


def test_layers_lie_below_the_skin_in_their_order():
    made = renderer(InsideConfig(blood=0.0002), triangles=cut())
    inner = made.model.select(np.arange(6000, len(made.model)))
    depth, (red, green, blue) = inner.means[:, 2].numpy() - SKIN, inner.base_colors.numpy().T
    assert depth.min() > -1e-4 and depth.max() < BACK - SKIN + 3e-4
    mean = lambda values, low, high: values[(depth > low) & (depth < high)].mean()
    for low, high, least, most in ((0.0004, 0.0008, 0.9, 1.1), (0.0015, 0.0025, 0.4, 0.8), (0.006, 0.015, 0.7, 1.1)):
        assert least < mean(blue, low, high) / mean(green, low, high) < most  # skin, yellow fat, red flesh
    assert mean(green, 0.006, 0.015) < 0.3 * mean(red, 0.006, 0.015)
    assert mean(red, 0.006, 0.015) < 0.8 * mean(red, 0.0015, 0.0025)
    assert mean(red, 0.009, 0.015) < 0.9 * mean(red, 0.005, 0.008)  # less light comes down there, and redder
    assert mean(green, 0.009, 0.015) / mean(green, 0.005, 0.008) < 0.95 * mean(red, 0.009, 0.015) / mean(red, 0.005, 0.008)


def test_the_skin_tells_what_is_below_it():
    model = skin()
    model.sh[model.means[:, 1] < -0.01, 0] += torch.tensor([0.05, 0.12, -0.05]) / SH_C0  # yellow
    model.sh[model.means[:, 1] > 0.01, 0] -= torch.tensor([0.3, 0.35, 0.35]) / SH_C0  # dark red, as a liver
    colors = {}
    for organ in (0.008, 0.0):
        inner = renderer(InsideConfig(blood=0.0, organ=organ), model, triangles=cut()).model.select(slice(6000, None))
        y, depth = inner.means[:, 1].numpy(), inner.means[:, 2].numpy() - SKIN
        for name, there in (("fat", y < -0.02), ("pink", abs(y) < 0.004), ("liver", y > 0.02)):
            for low, high in ((0.002, 0.0028), (0.005, 0.008)):
                red, green, blue = inner.base_colors.numpy()[there & (depth > low) & (depth < high)].mean(0)
                colors[organ, name, low] = green / red, (green - blue) / red
    for at in (0.002, 0.005):  # liver to its depth, fat farther down than elsewhere
        assert colors[0.008, "liver", at][1] < 0.05 and colors[0.0, "liver", 0.002][1] > 0.1
    assert colors[0.008, "fat", 0.005][0] > 0.4 > 0.3 > colors[0.0, "fat", 0.005][0]
    np.testing.assert_allclose(colors[0.008, "pink", 0.002], colors[0.0, "pink", 0.002], atol=0.05)
    np.testing.assert_allclose(colors[0.008, "pink", 0.005], colors[0.0, "pink", 0.005], atol=0.05)


def test_what_others_hide_and_where_the_world_begins_tell_no_organ():
    model = skin()
    green = torch.tensor([0.2, 0.7, 0.1])
    hidden = GaussianModel.from_points(model.means + torch.tensor([0.0, 0.0, 5e-4]), green.repeat(6000, 1), model.scales[:, 0], 0.95)
    bared = torch.cat([0 * model.sh[:, 0], model.sh[:, 0] - hidden.sh[:, 0]])
    both = {name: torch.cat([getattr(each, name) for each in (model, hidden)]) for name in model.tensors()}
    told = [Inside(each, nodes(), FLESH)._organs.at(model.means.numpy()) for each in (model, GaussianModel(**both, bared=bared))]
    np.testing.assert_allclose(*told, atol=0.02)
    one = np.array([[0.0, 0, 0]]), np.array([[0.2, 0.1, 0.1]])
    many = np.random.default_rng(0).uniform(0.0001, 0.004, (5000, 3)), np.tile([0.8, 0.7, 0.3], (5000, 1))
    mixed = [np.concatenate(pair) for pair in zip(one, many)]
    for shift in (0.0, 0.0021):
        np.testing.assert_allclose(
            OrganColors(mixed[0] + shift, mixed[1], 0.008).at(mixed[0] + shift), np.tile([0.8, 0.7, 0.3], (5001, 1)), atol=2e-3
        )


def test_the_line_of_blood_has_no_gaps():
    made = renderer(InsideConfig(blood=0.0004), triangles=cut())
    flesh = made.model.select(np.arange(len(made._skin), len(made.model)))
    depth = flesh.means[:, 2].numpy() - SKIN
    along = flesh.means[depth < 0.0004, 1].numpy()
    assert np.diff(np.sort(along[np.abs(along) < 0.03])).max() < 0.0004  # of the colour of blood, in all places along the cut
    assert np.unique(depth[depth < 0.001].round(5)).size >= 3  # in rows


@pytest.mark.parametrize("gloss", [False, True])
def test_a_closed_cut_is_a_line_of_blood_on_both_edges(gloss):
    camera, model = CAMERA.resized(384, 320), skin(gloss)
    dark, blood = (renderer(inside, model, triangles=cut(0.02)).render(camera)[0].astype(float) for inside in (DARK, FLESH))
    changed = np.abs(blood - dark).max(2) > 12
    rows = slice(40, 160 + int(480 * 0.02 / SKIN) - 8)  # in which the cut is seen
    column = round(192 + 480 * MIDDLE / SKIN)
    line = slice(column - 1, column + 1)
    assert changed[rows, line].any(1).mean() > 0.9
    changed[:, column - 4 : column + 4] = False
    assert changed.mean() < 1e-4
    if not gloss:
        red, green, blue = (blood[rows, line].sum(1) / dark[rows, line].sum(1)).T
        assert np.median(red) < 0.9 and np.median(green / red) < 0.9 and np.median(blue / red) < 0.9  # darker, and redder


def test_without_a_cut_and_with_a_closed_one_that_does_not_bleed_the_picture_is_the_same_bit_for_bit():
    state = opened(nodes())
    plain, made = renderer(DARK), renderer()
    assert made.model is made._skin and np.array_equal(made.render(CAMERA, *state)[0], plain.render(CAMERA, *state)[0])
    closed = [renderer(inside, triangles=cut()) for inside in (DARK, InsideConfig(blood=0.0))]
    assert len(closed[1].model) > 6000
    for positions in ((), (nodes(), np.tile(np.eye(3), (len(nodes()), 1, 1)))):
        images = [each.render(CAMERA, *positions) for each in closed]
        assert all(np.array_equal(a, b) for a, b in zip(*images))
    closed[1].cut(np.zeros((0, 3, 3)))  # healed
    assert len(closed[1].model) == 6000
    assert np.array_equal(closed[1].render(CAMERA, *state)[0], plain.render(CAMERA, *state)[0])


@pytest.mark.thorough
def test_the_same_cuts_and_seed_give_the_same_flesh_however_they_come():
    state, triangles = opened(nodes()), cut()
    first, other = renderer(triangles=triangles), renderer(InsideConfig(seed=1), triangles=triangles)
    piecewise = renderer(triangles=cut(-0.03))
    piecewise.cut(np.concatenate([triangles[: len(cut(-0.03))], triangles[len(cut(-0.03)) : -6]]))
    piecewise.cut(np.zeros((0, 3, 3)))
    for end in (40, 44, len(triangles)):
        piecewise.cut(triangles[:end])
    for one, two in zip(first.model.tensors().values(), piecewise.model.tensors().values()):
        assert torch.equal(one, two)
    for one, two in zip(first.deform(*state), piecewise.deform(*state)):
        assert torch.equal(one, two)
    assert len(first.model) == len(other.model) and not torch.equal(first.model.sh, other.model.sh)


def test_flesh_does_not_tell_where_dye_was_before_cuts_healed():
    there, elsewhere = (DyedSpot(np.array([MIDDLE, y, SKIN]), 0.004) for y in (0.0, 0.02))
    rest = nodes()
    used, fresh = renderer(), renderer()
    used.dye([elsewhere])
    used.cut(cut(0.05))  # so that its flesh is made
    for each in (used, fresh):
        each.dye([there])
        each.cut(cut())
    pictures = [each.render(CAMERA, *opened(rest))[0] for each in (used, fresh)]
    np.testing.assert_array_equal(*pictures)


def test_both_faces_follow_the_nodes_on_their_own_side():
    made = renderer(triangles=cut())
    means = made.deform(*opened(nodes()))[0]
    inner, moved = made.model.means[6000:].numpy(), (means - made.model.means)[6000:, 0].numpy()
    expected = np.where(inner[:, 0] > MIDDLE, OPENED, -OPENED) * (BACK - inner[:, 2]) / (BACK - SKIN)
    assert (inner[::2, 0] > MIDDLE).all() != (inner[1::2, 0] > MIDDLE).all()
    np.testing.assert_allclose(moved, expected, atol=6e-5)  # blood lies above the skin


@pytest.mark.thorough
def test_flesh_reflects_as_much_of_its_own_light_as_the_skin_beside_it_and_does_not_glint():
    model = skin(gloss=True)
    made = renderer(InsideConfig(blood=0.0), model, triangles=cut())
    flesh, skins = made.model.gloss[6000:], {tuple(row[3:6].tolist()): number for number, row in enumerate(model.gloss)}
    above = [skins[tuple(row)] for row in flesh[:, 3:6].tolist()]  # films are those of the skin
    right = made.model.means[6000:, 0] > MIDDLE
    torch.testing.assert_close(
        flesh[:, :3], torch.tensor([-1.0, 0, 0]) * torch.where(right, 1.0, -1.0)[:, None]
    )  # each face looks at the other
    light, (sheen, glint) = (made.model.base_colors**2).mean(1), softplus(made.model.gloss[:, 6:]).T
    near = (made.model.means[above, None] - model.means).norm(dim=2).topk(16, largest=False).indices
    reflected = sheen[near].mean(1) / light[near].mean(1)
    # Skin nearby is told where the cut is, a little aside.
    torch.testing.assert_close((sheen[6000:] / light[6000:]).median(), reflected.median(), rtol=0.03, atol=0)
    assert len(flesh) > 1000 and (sheen[6000:] / light[6000:]).std() < 0.3 * reflected.median()
    assert (sheen[6000:] / sheen[above]).min() < 0.1 and (glint[6000:] < 1e-5).all()
    assert made.render(CAMERA, *opened(nodes()))[0].any()


@pytest.mark.parametrize("case", ["no layers", "in the air", "beside it"])
def test_where_there_is_no_inside_there_is_no_flesh(case):
    rest = skin().means[::12].double().numpy() if case == "no layers" else nodes()
    triangles = {"no layers": cut(), "in the air": cut() - [0, 0, 0.05], "beside it": cut() + [0.0, 0.2, 0.0]}[case]
    assert len(renderer(rest=rest, triangles=triangles).model) == 6000
