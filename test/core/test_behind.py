"""What is behind the skin where tissue is lifted off what it hid."""

import numpy as np
import pytest
import torch
from test_inside import CAMERA, DARK, OPENED, SKIN, cut, nodes, opened, skin
from torch.nn.functional import softplus

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.kernels import launch_in_shares, load_kernels
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig, behind_kernels
from endo_sim_ros.rendering.config import BehindConfig, InsideConfig


def sampled(gloss: bool = False) -> tuple[GaussianModel, np.ndarray]:
    """A skin, and control nodes, of which those in front are some of its Gaussians."""
    model, rest = skin(gloss), nodes()
    model.means[:441] = torch.from_numpy(rest[:441]).float()
    return model, np.concatenate([model.means[:441].double().numpy(), rest[441:]])


def renderer(shown: bool, inside: InsideConfig = DARK, gloss: bool = False, background: float = 0.0) -> DeformableRenderer:
    model, rest = sampled(gloss)
    return DeformableRenderer(
        model, rest, RenderingConfig(device="cpu", inside=inside, behind=BehindConfig(shown=shown), background=background)
    )


def torn(rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The skin of one half folded away to the side, deeper tissue where it was."""
    moved = rest.copy()
    moved[(rest[:, 0] < 0) & (rest[:, 2] < SKIN + 1e-3), 0] -= 0.02
    return moved, np.tile(np.eye(3), (len(rest), 1, 1))


@pytest.mark.parametrize("gloss", [False, True])
def test_where_skin_has_moved_off_what_it_hid_dim_tissue_is_seen(gloss):
    rest = sampled()[1]
    without, with_it = (renderer(shown, gloss=gloss).views([CAMERA], *torn(rest), labels=True)[0] for shown in (False, True))
    gap = without.labels == 0
    assert gap.sum() > 300 and (with_it.labels[gap] == 0).mean() < 0.02
    seen = with_it.image[gap].astype(float)
    assert (0.3 if gloss else 0.4) < seen.mean() / with_it.image[:, 80:].astype(float).mean() < 0.9
    assert (seen[:, 0] > seen[:, 1]).mean() > 0.95  # of the colour of the skin
    assert (with_it.depth[gap & (with_it.labels > 0)] > SKIN).all()
    np.testing.assert_array_equal(with_it.image[:, 80:], without.image[:, 80:])  # where the skin covers it all


def test_what_is_behind_reflects_less_the_darker_it_is_and_does_not_glint():
    rest = sampled()[1]
    gap, drawn = renderer(False).views([CAMERA], *torn(rest), labels=True)[0].labels == 0, []
    for sheen in (-20.0, 3.0):
        model, _ = sampled(gloss=True)
        model.gloss[:, 6], model.gloss[:, 7] = sheen, 5.0
        made = DeformableRenderer(model, rest, RenderingConfig(device="cpu", inside=DARK, behind=BehindConfig(shown=True, dark=0.9)))
        drawn.append(made.views([CAMERA], *torn(rest))[0].image[gap].astype(float).mean())
        assert softplus(made._behind._model.gloss[:, 7]).max() < 1e-5
    # A sheen of 3 is as bright as white, but where a tenth of the light comes: 1 % of it is left, as colours are roots of light.
    assert drawn[0] < 40 and drawn[0] < drawn[1] < 80


def test_thin_places_of_skin_that_stays_on_it_are_as_bright_as_the_skin():
    model, rest = sampled()
    hole = (model.means[:, :2] - torch.tensor([0.02, 0.0])).norm(dim=1) < 0.006
    model.logit_opacities[441:][hole[441:]] = -9.0
    made = DeformableRenderer(model, rest, RenderingConfig(device="cpu"))
    bright = {}
    for lift in (0.0, 0.004):
        moved = rest + [0.0, 0.003, 0.0]
        moved[rest[:, 2] < SKIN + 1e-3, 2] -= lift
        image = made.views([CAMERA], moved, np.tile(np.eye(3), (len(rest), 1, 1)))[0].image.astype(float)
        bright[lift] = np.median(image[40:48, 69:77]) / np.median(image[40:48, 20:40])
    assert 0.85 < bright[0.0] < 1.1 and bright[0.004] < 0.9 * bright[0.0]


def test_at_rest_and_where_nothing_moves_the_picture_is_the_same_bit_for_bit():
    rest = sampled()[1]
    identity = rest, np.tile(np.eye(3), (len(rest), 1, 1))
    for state in ((), identity):
        pair = [renderer(shown, background=0.3).views([CAMERA], *state)[0] for shown in (False, True)]
        np.testing.assert_array_equal(pair[0].image, pair[1].image)
        np.testing.assert_array_equal(pair[0].depth, pair[1].depth)


def test_beside_a_cut_there_is_flesh_or_with_no_inside_nothing():
    rest = sampled()[1]
    state, colors = opened(rest), []
    for shown, inside in ((False, DARK), (True, DARK), (True, InsideConfig())):
        made = renderer(shown, inside)
        made.cut(cut())
        colors.append(made.views([CAMERA], *state)[0].image.astype(int))
    middle = np.abs(np.arange(96) + 0.5 - 48) < 0.5 * 120 * OPENED / SKIN
    np.testing.assert_array_equal(colors[0][:, middle], colors[1][:, middle])
    red, green, _ = np.moveaxis(colors[2][:, middle], -1, 0)
    assert np.median(red) > 40 and np.median(red) > 1.5 * np.median(green)
    made.cut(np.zeros((0, 3, 3)))
    healed, whole = (each.views([CAMERA], *torn(rest))[0].image for each in (made, renderer(True)))
    np.testing.assert_array_equal(healed, whole)


def test_a_bare_skin_has_nothing_behind_it():
    model, rest = sampled()
    rest = rest[:441]
    pair = [
        DeformableRenderer(model, rest, RenderingConfig(device="cpu", behind=BehindConfig(shown=shown))).views([CAMERA], *torn(rest))[0]
        for shown in (False, True)
    ]
    np.testing.assert_array_equal(pair[0].image, pair[1].image)


def test_what_is_behind_comes_between_its_pixels_in_straight_lines():
    rng = torch.Generator().manual_seed(0)
    random = lambda *shape: torch.rand(*shape, generator=rng)
    background, coarse = random(3), [random(2, 5, 7, 3), random(2, 5, 7), random(2, 5, 7)]
    images = [random(2, 21, 29, 3), random(2, 21, 29), random(2, 21, 29)]
    y, x = torch.meshgrid((2 * torch.arange(21) + 1) / 21 - 1, (2 * torch.arange(29) + 1) / 29 - 1, indexing="ij")
    layers = torch.cat([coarse[0] - background, coarse[1][..., None], coarse[2][..., None]], 3).permute(0, 3, 1, 2)
    places = torch.stack([x, y], 2).expand(2, 21, 29, 2)
    found = torch.nn.functional.grid_sample(layers, places, padding_mode="border", align_corners=False).permute(0, 2, 3, 1)
    found *= (1 - images[2] / 0.6).clamp_min(0)[..., None]
    expected = [images[0] + found[..., :3], images[1] + found[..., 3], images[2] + found[..., 4]]
    load_kernels((behind_kernels,), "cpu")
    launch_in_shares(behind_kernels.put_behind, 2 * 21, [29, 21, 29, 0.6, background, *coarse, *images])
    for mine, other in zip(images, expected):
        torch.testing.assert_close(mine, other, atol=1e-5, rtol=0)


def test_whole_rows_give_the_pictures_of_single_pixels():
    rng, (height, width) = np.random.default_rng(0), (13, 45)
    tensor = lambda *shape: torch.from_numpy(rng.uniform(size=shape)).float()
    behind = torch.zeros(2, 4, 11)
    for picture, row, first, last in ((0, 1, 0, 2), (0, 3, 5, 6), (1, 0, 9, 11), (1, 2, 4, 5)):
        behind[picture, row, first:last] = 0.9
    coarse = [tensor(2, 4, 11, 3) * behind[..., None], 0.1 * behind, behind]
    images = [tensor(2 * height * width, 3), tensor(2 * height * width), tensor(2 * height * width)]
    load_kernels((behind_kernels,), "cpu")
    found = []
    for span in (1, width):
        copies = [each.clone() for each in images]
        arguments = [span, height, width, 0.85, torch.zeros(3), *coarse, *copies]
        launch_in_shares(behind_kernels.put_behind, 2 * height * width // span, arguments)
        found.append(copies)
    assert (found[0][2] != images[2]).sum() > 100
    for by_pixel, by_row in zip(*found):
        assert torch.equal(by_pixel, by_row)
