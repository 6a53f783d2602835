"""Light that tissue reflects: a layer of its own, so that highlights stay with the light and the lens while the tissue moves.

Lamp and lens of an endoscope are nearly in one place. So what a surface gives back depends on the cosines between the direction
towards the lens and two normals, c that of the surface and f that of the wet film on it, which ripples:

    colour = base · c^facing + sheen · exp(p_sheen (c − 1)) + glint · exp(p_glint (f − 1))

The first term is the tissue itself, the others are reflected and white: a broad lobe, and a narrow one that makes glints where the
film happens to face the lens. Each lobe is a spherical Gaussian (Wang et al. 2009). Every Gaussian of a model has the two normals
and two strengths, `GaussianModel.gloss`, which holds log(exp(strength) − 1), so that training goes slowly near nothing and never
below it. The sharpnesses p and the exponent are those of its `Light`. Normals turn with the tissue (`Skinning.cosines`). Colours are
those before the light's falloff and the exposure, like the tissue's own.
"""

import torch
from torch import Tensor
from torch.nn.functional import normalize, softplus

from endo_sim_ros.core.gaussians import SH_C0, GaussianModel

# Least cosine that shades. Normals in folds are known too badly for more: tissue that seems to be seen at a grazing angle would be given
# a colour so bright that it flashes once it is pulled towards the lens.
_GRAZING = 0.5


def cosines(model: GaussianModel, positions: Tensor) -> Tensor:
    """Return the cosines [..., N, 2] between the normals of a model at rest, of surface and film, and the directions towards a lens.

    Gradients flow to the normals of the film alone: colours do not pull on the surface.

    Args:
        model: Gaussians with `gloss`.
        positions: Where the lens is [..., 1, 3], or where it is for each Gaussian [..., N, 3], metres, world.
    """
    assert model.gloss is not None  # nothing else is asked for
    normals = torch.stack([model.gloss[:, :3].detach(), model.gloss[:, 3:6]], 1)
    towards = normalize(positions - model.means.detach(), dim=-1)
    return (normalize(normals, dim=-1) * towards[..., None, :]).sum(-1)


def seen_colors(model: GaussianModel, cosine: Tensor, sh: Tensor | None = None) -> Tensor:
    """Return coefficients of degree 0 [..., N, 1, 3] of the colours that a lens sees under these cosines [..., N, 2]; with gradients.

    Args:
        model: Gaussians that reflect.
        cosine: Of their normals and the directions towards the lens.
        sh: Coefficients [..., N, 1, 3] of the tissue itself in place of the model's.
    """
    facing, reflected = _shading(model, cosine)
    base = (model.sh if sh is None else sh) * SH_C0 + 0.5
    return (base * facing + (reflected - 0.5)) / SH_C0


def unlit(model: GaussianModel, cosine: Tensor) -> Tensor:
    """Return coefficients [N, 1, 3] with which Gaussians that are seen under these cosines [N, 2] have the model's own colours."""
    facing, reflected = _shading(model, cosine)
    base = (model.sh[:, :1] * SH_C0 + 0.5 - reflected).clamp_min(0) / facing
    return (base - 0.5) / SH_C0


def darkening(cosine: Tensor, facing: float) -> Tensor:
    """Return the factor [...] by which tissue is as bright as if it faced the lens, for cosines [...] and the exponent of a `Light`."""
    return cosine.clamp_min(_GRAZING) ** facing


def _shading(model: GaussianModel, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """The factor on a Gaussian's own colour, and what is reflected [..., N, 1, 1]."""
    light, gloss = model.light, model.gloss
    assert light is not None and gloss is not None
    sheen, glint = softplus(gloss[:, 6:, None, None]).unbind(1)
    surface, film = cosine[..., None, None].unbind(-3)
    reflected = sheen * (light.sheen_sharpness * (surface - 1)).exp() + glint * (light.glint_sharpness * (film - 1)).exp()
    return darkening(surface, light.facing), reflected
