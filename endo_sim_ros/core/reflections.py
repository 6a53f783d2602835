"""Light that tissue reflects: a layer of its own, so that highlights stay with the light and the lens while the tissue moves.

Lamp and lens of an endoscope are nearly in one place. So what a surface gives back depends on the directions towards the lens, v, and
on two normals, that of the surface and that of the wet film on it, which ripples:

    colour² = (Σ w √((base · c^facing)² + sheen · exp(p_sheen (c − 1))))² + Σ w · Σ w glint · exp(−½ p_glint |m − v|²)

The base is the tissue itself, the others are reflected and white: a broad lobe, and a narrow one that makes glints where the film happens
to face the lens. They are light, and add up as light does; colours are those of encoded images, roughly its square root. So white light
changes the darkest channel of a colour most. Each lobe is a spherical Gaussian (Wang et al. 2009). Base and sheen are of each Gaussian,
with weight w in a pixel: c is the cosine between v and the normal of its surface. Glints are of each pixel (deferred shading), as splats
are wider than the ripples: v is the way back along the pixel's ray, and m the mean normal of the films Σ w n / Σ w that the pixel sees.
Where films face different ways, as at the edge of tissue before other tissue, m is short, and they glint less.

Every Gaussian of a model has the two normals and two strengths, `GaussianModel.gloss`, which holds log(exp(strength) − 1), so that
training goes slowly near nothing and never below it. The sharpnesses p and the exponent are those of its `Light`. Normals turn with the
tissue (`Skinning.seen`). Colours are those before the light's falloff and the exposure, like the tissue's own.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize, softplus

from endo_sim_ros.core import glint_kernels
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.kernels import launch, launch_in_shares, load_kernels
from endo_sim_ros.core.native import LANE_COUNT

# Least cosine that shades. Normals in folds are known too badly for more: tissue that seems to be seen at a grazing angle would be given
# a colour so bright that it flashes once it is pulled towards the lens.
GRAZING = 0.5
DARKEST = 1 / 255  # of white: below it a root's gradient grows without end, and that of a square goes to nothing


class Facing(NamedTuple):
    """How N Gaussians face B lenses."""

    cosines: Tensor  # [B, N] between the normals of the surface and the directions towards the lens
    films: Tensor  # [N, 4], unit normals of the film, world, and the strengths of glints: `extras` of `rasterize`


class Seen(NamedTuple):
    """What B lenses see of N Gaussians."""

    sh: Tensor  # [B, N, 1, 3] coefficients of degree 0 of their colours without glints
    films: Tensor  # [N, 4], or [B, N, 4]: those of a `Facing`


def facing(model: GaussianModel, positions: Tensor) -> Facing:
    """Return how a model at rest faces lenses, and in what films.

    Gradients flow to films alone: colours do not pull on the surface.

    Args:
        model: Gaussians with `gloss`.
        positions: Where the lens is [3], or B are [B, 1, 3], or where it is for each Gaussian [N, 3], m, world.
    """
    assert model.gloss is not None  # nothing else is asked for
    normals = normalize(model.gloss[:, :3].detach(), dim=-1)
    towards = normalize(positions - model.means.detach(), dim=-1)
    films = torch.cat([normalize(model.gloss[:, 3:6], dim=-1), softplus(model.gloss[:, 7:])], 1)
    return Facing((normals * towards).sum(-1), films)


def seen_colors(model: GaussianModel, cosines: Tensor) -> Tensor:
    """Return coefficients of degree 0 [..., N, 1, 3] of the colours without glints that a lens sees; with gradients.

    Args:
        model: Gaussians that reflect.
        cosines: Those of a `Facing` [..., N].
    """
    assert model.light is not None
    own = (model.sh * SH_C0 + 0.5).clamp_min(0) * _column(darkening(cosines, model.light.facing))
    light = own.square() + _sheen(model, cosines)
    return (light.clamp_min(1e-12).sqrt() - 0.5) / SH_C0  # the root of 0 has no gradient


def add_glints(colors: Tensor, films: Tensor, alphas: Tensor, viewmats: Tensor, Ks: Tensor, sharpness: float) -> Tensor:
    """Return pictures [C, H, W, 3] with glints; gradients flow to the first three.

    Args:
        colors: Colours of C pictures [C, H, W, 3].
        films: What was drawn of the films of a `Seen` [C, 4, H, W].
        alphas: Opacities Σ w [C, H, W].
        viewmats: World to camera [C, 4, 4].
        Ks: Intrinsics [C, 3, 3], pixels.
        sharpness: That of the light.
    """
    return _Glints.apply(colors, films, alphas, viewmats, Ks, sharpness)


def unlit(model: GaussianModel, cosines: Tensor) -> Tensor:
    """Return coefficients [N, 1, 3] with which Gaussians that are seen under these cosines [N] have the model's own colours, if their
    films are as their surfaces."""
    light, gloss = model.light, model.gloss
    assert light is not None and gloss is not None
    glint = softplus(gloss[:, 7]) * (light.glint_sharpness * (cosines - 1)).exp()
    own = (model.sh[:, :1] * SH_C0 + 0.5).square() - _sheen(model, cosines) - _column(glint)
    return (own.clamp_min(DARKEST**2).sqrt() / _column(darkening(cosines, light.facing)) - 0.5) / SH_C0


def without_glints(gloss: Tensor, sheen: Tensor) -> Tensor:
    """Return `gloss` [N, 8] with other strengths of the sheen [N], and without glints.

    Of what nobody saw, as flesh: its films are not known, and those of the skin would shine out of the dark.
    """
    return torch.cat([gloss[:, :6], stored_strengths(torch.stack([sheen, torch.zeros_like(sheen)], 1))], 1)


def stored_strengths(strengths: Tensor) -> Tensor:
    """Return strengths [...] as `gloss` holds them; of none a millionth, which is nothing in a picture."""
    strengths = strengths.clamp_min(1e-6)
    return strengths + (-(-strengths).expm1()).log()  # exp(strength) would be too large a number of some


def darkening(cosines: Tensor, facing: float) -> Tensor:
    """Return the factor [...] by which tissue is as bright as if it faced the lens, for cosines [...] and the exponent of a `Light`."""
    return cosines.clamp_min(GRAZING) ** facing


def _sheen(model: GaussianModel, cosines: Tensor) -> Tensor:
    """The broad lobe [..., N, 1, 1]."""
    light, gloss = model.light, model.gloss
    assert light is not None and gloss is not None
    return _column(softplus(gloss[:, 6]) * (light.sheen_sharpness * (cosines - 1)).exp())


def _column(values: Tensor) -> Tensor:
    return values[..., None, None]


class _Glints(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor, films: Tensor, alphas: Tensor, viewmats: Tensor, Ks: Tensor, sharpness: float) -> Tensor:
        films, alphas = films.contiguous(), alphas.contiguous()
        ctx.sharpness = sharpness
        seen = colors.clone(memory_format=torch.contiguous_format)
        _launch(glint_kernels.add_glints, films, alphas, viewmats, Ks, sharpness, seen)
        ctx.save_for_backward(films, alphas, viewmats, Ks, colors, seen)
        return seen

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        films, alphas, *matrices, colors, seen = ctx.saved_tensors
        v_films, v_alphas = torch.empty_like(films), torch.empty_like(alphas)
        v_light = (0.5 * v_colors / seen.clamp_min(DARKEST)).sum(-1)
        _launch(glint_kernels.glint_gradients, films, alphas, *matrices, ctx.sharpness, v_light, v_films, v_alphas)
        return v_colors * torch.where(seen > 0, colors / seen, 1), v_films, v_alphas, None, None, None


def _launch(kernel: Any, films: Tensor, alphas: Tensor, viewmats: Tensor, Ks: Tensor, sharpness: float, *images: Tensor) -> None:
    load_kernels((glint_kernels,), str(alphas.device))
    cameras, height, width = alphas.shape
    seen = [each.float().contiguous().view(-1) for each in (films, alphas, viewmats, Ks)]
    arguments = [width, height, *seen, sharpness, *(image.view(-1) for image in images)]
    if alphas.device.type == "cpu":
        launch_in_shares(kernel, cameras * height * -(-width // LANE_COUNT), arguments)  # pixels of a row at once
    else:
        launch(kernel, alphas.numel(), [0, *arguments], alphas.device)
