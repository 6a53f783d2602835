"""What lies behind the skin where tissue gives way: nobody saw it, so it is made up.

A reconstruction is the skin that cameras saw. Where the edge of an organ is lifted off what it hid, or skin folds away, the background
would be seen. What a reconstruction is put on, the control nodes below the skin, is drawn there as dim tissue of the colours around, beside
a cut as flesh. It is behind all else, and counts as far as the skin above it has moved.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import upload
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.kernels import launch, launch_in_shares, load_kernels
from endo_sim_ros.core.reflections import without_glints
from endo_sim_ros.physics.control_nodes import select_solid
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.physics.weights import nearest_nodes
from endo_sim_ros.rendering import behind_kernels
from endo_sim_ros.rendering.config import BehindConfig
from endo_sim_ros.rendering.inside import SOLID, Inside, light_of, value_noise
from endo_sim_ros.splatting import camera_arrays, render_from

_OPACITY = 0.97
_WIDE, _FLAT = 0.8, 0.1  # standard deviations along the layer and across it, in distances between control nodes
_COARSER = 4  # pixels of a picture to one of what is behind, each way: it is a blur
_COVERED = 0.85  # opacity of tissue that shows nothing of it: skin that was trained over a black background lets a tenth through
_LIFTED = 0.5  # part of their distance by which skin must have left what is behind it, so that this is in the dark
_MOVED = 0.1  # such distances by which the skin must have moved
_BESIDE = 3.5  # such distances from a cut that count as beside it: what is farther away does not reach it
_ABOVE = 4  # control nodes of the skin that tell how far it has moved


class Behind:
    """Tissue behind a model's skin, on the device of its skinning.

    Args:
        model: Gaussians at rest, world.
        skinning: What moves them. Control nodes that are no Gaussians of the model are behind its skin.
        config: How it looks.
    """

    def __init__(self, model: GaussianModel, skinning: Skinning, config: BehindConfig) -> None:
        means, rest = (each.cpu().double().numpy() for each in (model.means, skinning.node_rest))
        solid = select_solid(means, model.opacities.cpu().double().numpy(), SOLID)
        self.device, self._deep = skinning.device, torch.zeros(0, dtype=torch.long)
        if not len(solid) or len(rest) < 2:
            return
        distances, nearest = (each[:, 0] for each in nearest_nodes(means[solid], rest, 1))
        apart = np.median(nearest_nodes(rest, rest, 2)[0][:, 1])
        deep, skin = np.flatnonzero(distances > 1e-3 * apart), np.flatnonzero(distances <= 1e-3 * apart)
        if not len(deep) or not len(skin):
            return
        on = lambda values, kind=torch.float32: torch.from_numpy(values).to(self.device, kind)
        above = nearest_nodes(rest[skin], rest[deep], min(_ABOVE, len(skin)))[1]
        self._deep, self._above = on(deep, torch.long), on(skin[above], torch.long)
        wide = float(np.median(nearest_nodes(rest[skin], rest[skin], min(2, len(skin)))[0][:, -1]))
        inward = rest[deep] - means[solid][nearest[deep]]
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        covars = (_WIDE * wide) ** 2 * (np.eye(3) - (1 - (_FLAT / _WIDE) ** 2) * inward[:, :, None] * inward[:, None])
        colors = model.base_colors.cpu().double().numpy()[solid][nearest[deep]]
        colors = np.clip(colors * (1 + 0.12 * value_noise(rest[deep], 0.004, 0)[:, None]), 0, 1)
        self._rest, self._covars, self._moved, self._wide = skinning.node_rest, on(covars), _MOVED * wide, wide
        self._places, self._colors, self._dark = rest[deep], colors, config.dark
        self._light, self._gloss = model.light, None
        if model.gloss is not None:
            self._gloss = model.gloss[on(solid[nearest[deep]], torch.long).to(model.gloss.device)].to(self.device)
        self._apart = self._separation(self._rest, slice(None))
        self.heal()
        load_kernels((behind_kernels,), str(self._rest.device))
        # What is loaded at first use would make the first picture of a pull late.
        nowhere, none = Camera(np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]), 16, 16), self._rest.new_zeros
        moved, F = self._rest + 1.0, torch.eye(3, device=self.device).expand(len(rest), 3, 3)
        matrices = upload(self.device, *camera_arrays([nowhere]))
        self.draw(matrices, moved, F, (none(1, 16, 16, 3), none(1, 16, 16), none(1, 16, 16)), none(3))

    def cut(self, triangles: np.ndarray, inside: Inside | None) -> None:
        """Show flesh beside new cuts [T, 3, 3], m, world, in the tissue at rest; without an inside, nothing."""
        if not len(self._deep):
            return
        known = np.concatenate([triangles.reshape(-1, 3), triangles.mean(1)])
        near = np.flatnonzero(~self._beside & (nearest_nodes(known, self._places, 1)[0][:, 0] < _BESIDE * self._wide))
        if not len(near):
            return
        self._beside[near] = True
        if inside is None:
            self._hides[torch.from_numpy(near).to(self.device)] = torch.inf
        else:
            self._shown[near] = inside.colors(self._places[near], np.full(len(near), np.inf))
            self._show()

    def heal(self) -> None:
        """Forget all cuts."""
        if len(self._deep):
            self._beside, self._hides = np.zeros(len(self._deep), bool), self._rest.new_zeros(len(self._deep))
            self._shown = self._colors.copy()
            self._show()

    def _show(self) -> None:
        """Have the colours that are shown."""
        share = light_of(self._shown) / np.maximum(light_of(self._colors), 1e-9)
        colors, share = (torch.from_numpy(each).float().to(self.device) for each in (self._shown, share.clip(0, 1)))
        made = GaussianModel.from_points(self._rest[self._deep], colors, self._rest.new_ones(len(colors)), _OPACITY)
        self._model = replace(made, light=self._light, gloss=_dimmed(self._gloss, share))

    def _separation(self, positions: Tensor, some: Tensor | slice) -> Tensor:
        """How far some of the D nodes behind the skin are from those of the skin above them, m."""
        return (positions[self._above[some]] - positions[self._deep[some]][:, None]).norm(dim=2).mean(1)

    def draw(
        self, matrices: Sequence[Tensor], positions: Tensor, F: Tensor, images: tuple[Tensor, Tensor, Tensor], background: Tensor
    ) -> None:
        """Put it behind colours [E, H, W, 3], depths and alphas [E, H, W] that cameras see of tissue, which are changed in place.

        Args:
            matrices: Of E cameras, on the device, as `camera_arrays` has them.
            positions: Control nodes now [M, 3], m, world.
            F: Their deformation gradients [M, 3, 3].
            images: What they see, on a background.
            background: Its colour [3].
        """
        if not len(self._deep):
            return
        moved = (positions - self._rest).norm(dim=1)[self._above].amax(1) - self._hides
        some = slice(None)  # a GPU draws all sooner than the host would hear which
        if moved.device.type == "cpu":
            some = (moved > self._moved).nonzero()[:, 0]
            if not len(some):
                return
        numbers = self._deep[some]
        shown = (_OPACITY * (moved[some] / self._moved - 1).clamp(0, 1)).logit()
        lifted = ((self._separation(positions, some) / self._apart[some] - 1) / _LIFTED).clamp(0, 1)
        model, F = self._model.select(some), F[numbers]
        bright = 1 - self._dark * lifted  # skin that is only pressed has thin places, no shade
        sh = (model.sh + 0.5 / SH_C0) * bright[:, None, None] - 0.5 / SH_C0
        model = replace(model, means=positions[numbers], logit_opacities=shown, sh=sh, gloss=_dimmed(model.gloss, bright**2))
        colors, depths, alphas = images
        height, width = alphas.shape[1:]
        viewmats, Ks, eyes = matrices
        coarse = max(width // _COARSER, 1), max(height // _COARSER, 1)
        Ks = torch.stack([Ks[:, 0] * (coarse[0] / width), Ks[:, 1] * (coarse[1] / height), Ks[:, 2]], 1)
        covars = F @ self._covars[some] @ F.transpose(1, 2)
        behind = render_from(model, viewmats, Ks, eyes, *coarse, covars=covars, background=background)
        arguments = [background, behind.colors, behind.depths, behind.alphas, colors, depths, alphas]
        if alphas.device.type == "cpu":
            launch_in_shares(behind_kernels.put_behind, len(alphas) * height, [width, height, width, _COVERED, *arguments], least=4)
        else:
            launch(behind_kernels.put_behind, alphas.numel(), [0, 1, height, width, _COVERED, *arguments], alphas.device)


def _dimmed(gloss: Tensor | None, share: Tensor) -> Tensor | None:
    """`gloss` [N, 8] of tissue that has shares [N] of its light."""
    return None if gloss is None else without_glints(gloss, softplus(gloss[:, 6]) * share)
