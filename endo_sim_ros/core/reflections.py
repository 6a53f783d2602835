"""Light that tissue reflects: a layer of its own, so that highlights stay with the light and the lens while the tissue moves.

Lamp and lens of an endoscope are nearly in one place. So what a surface gives back depends on the cosine c between its normal and
the direction towards the lens:

    colour = base · c^facing + sheen · exp(p_sheen (c − 1)) + glint · exp(p_glint (c − 1))

The first term is the tissue itself, the others are reflected at its wet film and white: a broad lobe, and a narrow one that makes
glints where the film happens to face the lens. Each lobe is a spherical Gaussian (Wang et al. 2009). Every Gaussian of a model has
a normal and two strengths, `GaussianModel.gloss`; the sharpnesses p and the exponent are those of its `Light`. Normals turn with the
tissue (`Skinning.cosines`). Colours are those before the light's falloff and the exposure, like the tissue's own.
"""

from torch import Tensor
from torch.nn.functional import normalize

from endo_sim_ros.core.gaussians import SH_C0, GaussianModel

_GRAZING = 0.1  # least cosine: what is seen from behind is as bright as what is seen at a grazing angle


def cosines(model: GaussianModel, positions: Tensor) -> Tensor:
    """Return the cosines [..., N] between the normals of a model at rest and the directions towards a lens.

    Gradients flow to the normals alone: colours do not pull on the surface.

    Args:
        model: Gaussians with `gloss`.
        positions: Where the lens is [..., 1, 3], or where it is for each Gaussian [..., N, 3], metres, world.
    """
    assert model.gloss is not None  # nothing else is asked for
    return (normalize(model.gloss[:, :3], dim=-1) * normalize(positions - model.means.detach(), dim=-1)).sum(-1)


def seen_colors(model: GaussianModel, cosine: Tensor) -> Tensor:
    """Return coefficients of degree 0 [..., N, 1, 3] of the colours that a lens sees under these cosines [..., N]; with gradients."""
    facing, reflected = _shading(model, cosine[..., None, None])
    base = model.sh[:, :1] * SH_C0 + 0.5
    return (base * facing + (reflected - 0.5)) / SH_C0


def unlit(model: GaussianModel, cosine: Tensor) -> Tensor:
    """Return coefficients [N, 1, 3] with which Gaussians that are seen under these cosines [N] have the model's own colours."""
    facing, reflected = _shading(model, cosine[:, None, None])
    base = (model.sh[:, :1] * SH_C0 + 0.5 - reflected).clamp_min(0) / facing
    return (base - 0.5) / SH_C0


def _shading(model: GaussianModel, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """The factor on a Gaussian's own colour and what is reflected [..., N, 1, 1], for cosines of this shape."""
    light, gloss = model.light, model.gloss
    assert light is not None and gloss is not None
    sheen, glint = gloss[:, 3:, None, None].unbind(1)
    off = cosine - 1
    reflected = (sheen + light.sheen_sharpness * off).exp() + (glint + light.glint_sharpness * off).exp()
    return cosine.clamp_min(_GRAZING) ** light.facing, reflected
