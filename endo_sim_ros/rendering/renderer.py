"""A Gaussian model that follows its control nodes, seen by a camera."""

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.light import Light
from endo_sim_ros.core.shading import shade, to_bytes
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.rendering.config import RenderingConfig
from endo_sim_ros.splatting import render, sh_basis

_MIN_ALPHA = 0.5  # below it there is no surface whose depth could be told


class DeformableRenderer:
    """Renders one model, at rest or deformed by control nodes.

    Args:
        model: Gaussians at rest, world.
        node_rest: Control nodes at rest [M, 3], metres, world; None renders the model at rest only.
        config: Options.
    """

    def __init__(self, model: GaussianModel, node_rest: np.ndarray | None, config: RenderingConfig):
        self.device = pick_device(config.device)
        self.model = model.detach().to(self.device)
        self.config = config
        self._background = torch.full((3,), config.background, device=self.device)
        self._skinning = None
        if node_rest is not None:
            self._skinning = Skinning(self.model, node_rest, neighbours=config.neighbours, weighting=config.skinning, device=self.device)

    def cut(self, triangles: np.ndarray) -> None:
        """Let the skin part where all these triangles [T, 3, 3] (m, world, in the tissue at rest) cut it."""
        if self._skinning is not None and not np.array_equal(triangles, self._skinning.cuts):
            self._skinning.cut(triangles)

    def camera(self, camera: Camera) -> Camera:
        """The camera at the configured image width."""
        width = self.config.image_width
        return camera.resized(width, max(round(camera.height * width / camera.width), 1)) if width else camera

    @torch.no_grad()
    def deform(self, positions: np.ndarray, F: np.ndarray) -> tuple[Tensor, Tensor]:
        """Centres [N, 3], m, and covariances [N, 3, 3], m², world, of the Gaussians for nodes at positions [M, 3] with F [M, 3, 3]."""
        return self._skinning.deform(positions, F)

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        positions: np.ndarray | None = None,
        F: np.ndarray | None = None,
        *,
        depth: bool = True,
        light: Light | None = None,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """RGB image [H, W, 3] uint8 and, if asked for, depth [H, W] float32 (m, 0 = no surface) for nodes at positions [M, 3]
        with F [M, 3, 3], in another light than the model's if one is given."""
        model, covars = self.model, None
        if positions is not None:
            means, covars = self.deform(positions, F)
            sh = turned_colors(model.sh, self._skinning, means, F, camera) if model.sh_degree else model.sh
            model = GaussianModel(means, model.quats, model.log_scales, model.logit_opacities, sh)
        output = render(model, camera, background=self._background, covars=covars)
        colors, alpha = output.colors[0], output.alphas[0]
        light = light or self.model.light
        if light is not None:
            colors = shade(light, colors, output.depths[0], alpha, camera)
        image = to_bytes(colors).cpu().numpy()
        if not depth:
            return image, None
        return image, torch.where(alpha > _MIN_ALPHA, output.depths[0] / alpha.clamp_min(1e-6), 0.0).cpu().numpy()


def turned_colors(sh: Tensor, skinning: Skinning, means: Tensor, F: Tensor | np.ndarray, camera: Camera) -> Tensor:
    """Degree 0 coefficients [N, 1, 3] of what a camera sees of colours sh [N, K, 3]: view directions turn back with the tissue.

    Args:
        sh: Of the Gaussians at rest.
        skinning: How they follow the nodes.
        means: Their centres now [N, 3], m, world.
        F: Deformation gradients of the nodes [M, 3, 3].
        camera: Where they are seen from.
    """
    position = torch.as_tensor(camera.position, dtype=torch.float32, device=means.device)
    directions = torch.nn.functional.normalize(means - position, dim=1)
    at_rest = torch.einsum("nij,ni->nj", skinning.rotations(F), directions)
    return (sh_basis(at_rest, sh.shape[1])[..., None] * sh).sum(1, keepdim=True) / SH_C0
