"""Spots of dye on tissue, as surgeons tattoo what they want to find again: they move with it, and the lamp shines on them.

Messages use it, and so nodes that start sooner without torch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

    from endo_sim_ros.core.gaussians import GaussianModel

METHYLENE_BLUE = (0.06, 0.22, 0.55)
_EDGE = 0.3  # of the radius, over which dye fades


@dataclass(frozen=True)
class DyedSpot:
    """A ball that dyes the tissue at rest within it.

    Args:
        place: Its centre [3], m, world.
        radius: m.
        color: RGB, 0 to 1.
    """

    place: np.ndarray
    radius: float
    color: tuple[float, ...] = METHYLENE_BLUE


def dyed(sh: Tensor, means: Tensor, spots: Iterable[DyedSpot]) -> Tensor:
    """Return the colour coefficients [N, K, 3] of Gaussians with these [N, K, 3] whose centres at rest are means [N, 3], m, world."""
    from endo_sim_ros.core.gaussians import SH_C0

    for spot in spots:
        distance = (means - means.new_tensor(spot.place)).norm(dim=1)
        share = ((spot.radius - distance) / (_EDGE * spot.radius) + 0.5).clamp(0, 1)[:, None, None]
        flat = sh.new_zeros(sh.shape[1:])
        flat[0] = (sh.new_tensor(spot.color) - 0.5) / SH_C0
        sh = sh * (1 - share) + flat * share
    return sh


def dyed_model(model: GaussianModel, spots: Sequence[DyedSpot]) -> GaussianModel:
    """Return the model with spots of dye, in its colours at rest and in those that are bared."""
    sh, bared = dyed(model.sh, model.means, spots), model.bared
    if bared is not None:
        bared = dyed(model.sh[:, :1] + bared[:, None], model.means, spots)[:, 0] - sh[:, 0]
    return dataclasses.replace(model, sh=sh, bared=bared)
