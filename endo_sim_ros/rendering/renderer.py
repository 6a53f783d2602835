"""Images and depth of a Gaussian model, at rest or as it follows its control nodes, in a camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import download, pick_device, single_threaded_torch, upload
from endo_sim_ros.core.dye import DyedSpot, dyed
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.light import SURFACE, Light
from endo_sim_ros.core.shading import shade, to_bytes
from endo_sim_ros.instruments.drawing import PosedInstruments
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.rendering.behind import Behind
from endo_sim_ros.rendering.config import RenderingConfig
from endo_sim_ros.rendering.inside import Inside, open_share
from endo_sim_ros.splatting import render, sh_basis


@dataclass(frozen=True)
class View:
    """What one eye sees.

    Args:
        image: RGB [H, W, 3], uint8.
        depth: Of the tissue or the instrument in each pixel [H, W], float32, m, 0 = no surface; None unless asked for.
        labels: What is in each pixel [H, W], uint8: 0 nothing, 1 tissue, 2 and up the links of the instruments, as
            `instruments.drawing.InstrumentDrawing.links` lists them; None unless asked for.
    """

    image: np.ndarray
    depth: np.ndarray | None
    labels: np.ndarray | None


class DeformableRenderer:
    """Renders one model, at rest or deformed by control nodes.

    Args:
        model: Gaussians at rest, world.
        node_rest: Control nodes at rest [M, 3], metres, world; None renders the model at rest only.
        config: Options.

    Attributes:
        sees_tissue: Whether the newest image shows any.

    Raises:
        ValueError: If the device is not there, there are no nodes, or positions are not finite.
    """

    def __init__(self, model: GaussianModel, node_rest: np.ndarray | None, config: RenderingConfig) -> None:
        self.device = pick_device(config.device)
        self.model = model.detach().to(self.device)
        self.config = config
        self.sees_tissue = True
        self._background = torch.full((3,), config.background, device=self.device)
        self.skinning: Skinning | None = None
        if node_rest is not None:
            options: dict[str, Any] = {"neighbours": config.neighbours, "weighting": config.skinning, "device": self.device}
            if not config.clamp_stretch:
                options["stretch"] = None
            self.skinning = Skinning(self.model, node_rest, **options)
        self._skin, self._undyed = self.model, self.model.sh
        self._inside: Inside | None = None  # from the first cut on
        self._behind: Behind | None = None
        if self.skinning is not None and config.behind.shown:
            self._behind = Behind(self.model, self.skinning, config.behind)

    def cut(self, triangles: np.ndarray) -> None:
        """Part the tissue along all cuts so far, triangles [T, 3, 3], metres, world, in the tissue at rest, and show flesh where it opens.

        The Gaussians of the flesh follow those of the skin in `model`.
        """
        if self.skinning is None or np.array_equal(triangles, self.skinning.cuts):
            return
        known = len(self.skinning.cuts)
        if not self.skinning.cut(triangles):
            self.model, known = self._skin, 0
            if self._inside is not None:
                self._inside.heal()
        if not self.config.inside.shown or not len(triangles):
            if self._behind is not None:
                self._behind.cut(triangles, None)
            return
        if self._inside is None:
            skin = replace(self._skin, sh=self._undyed)  # dye is on the skin alone, and may be elsewhere when cuts have healed
            self._inside = Inside(skin, self.skinning.node_rest.cpu().double().numpy(), self.config.inside)
        if self._behind is not None:
            self._behind.cut(triangles, self._inside)
        flesh = self._inside.faces(triangles[known:]).to(self.device)
        if len(flesh):
            self.skinning.append(flesh)
            both = {name: torch.cat([value, getattr(flesh, name)]) for name, value in self.model.tensors().items()}
            self.model = replace(self.model, **both)

    def dye(self, spots: Sequence[DyedSpot]) -> None:
        """Show the tissue with these spots of dye, and no others."""
        sh = dyed(self._undyed, self._skin.means, spots)
        self._skin = replace(self._skin, sh=sh)
        self.model = replace(self.model, sh=torch.cat([sh, self.model.sh[len(sh) :]]))

    def camera(self, camera: Camera) -> Camera:
        """Return the camera at the configured image width, with the height in proportion."""
        width = self.config.image_width
        return camera.resized(width, max(round(camera.height * width / camera.width), 1)) if width else camera

    @torch.no_grad()
    def deform(self, positions: np.ndarray, F: np.ndarray) -> tuple[Tensor, Tensor]:
        """Return centres [N, 3] (m) and covariances [N, 3, 3] (m²) of the Gaussians, world.

        Args:
            positions: Control nodes now [M, 3], metres, world.
            F: Their deformation gradients [M, 3, 3].

        Raises:
            ValueError: If the renderer has no control nodes, or shapes disagree.
        """
        if self.skinning is None:
            raise ValueError("this renderer has no control nodes and shows the model at rest only; give it node_rest")
        return self.skinning.deform(positions, F)

    def render(
        self,
        camera: Camera,
        positions: np.ndarray | None = None,
        F: np.ndarray | None = None,
        *,
        light: Light | None = None,
        lamp: Camera | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return an RGB image [H, W, 3], uint8, and the depth [H, W] that goes with it, float32, metres, 0 = no surface.

        Args:
            camera: Intrinsics, pose and image size.
            positions: Control nodes now [M, 3], metres, world; None renders the model at rest.
            F: Their deformation gradients [M, 3, 3]; given with positions.
            light: Light in place of the model's.
            lamp: A camera where the lamp is; None: this one.

        Raises:
            ValueError: If the renderer has no control nodes, F is missing, or shapes disagree.
        """
        (view,) = self.views([camera], positions, F, light=light, lamp=lamp)
        assert view.depth is not None  # asked for
        return view.image, view.depth

    @single_threaded_torch()
    @torch.no_grad()
    def views(
        self,
        cameras: Sequence[Camera],
        positions: np.ndarray | None = None,
        F: np.ndarray | None = None,
        *,
        depth: bool = True,
        labels: bool = False,
        light: Light | None = None,
        instruments: PosedInstruments | None = None,
        lamp: Camera | None = None,
    ) -> list[View]:
        """Return what the eyes of an endoscope see, with instruments in front of the tissue, within it and behind it.

        Light and exposure come after the instruments, so that they count in both.

        Args:
            cameras: One, or one for each eye, all of one size.
            positions, F, light: As for `render`.
            depth, labels: Whether to return these; None otherwise.
            instruments: What is drawn beside the tissue, on the device of the renderer; None = nothing.
            lamp: A camera where the lamp is; None: the first of the cameras.

        Raises:
            ValueError: As from `render`.
        """
        model, covars = self.model, None
        means = model.means
        if positions is not None:
            if F is None:
                raise ValueError("render: positions of control nodes go with their deformation gradients F; F is None")
            means, covars = self.deform(positions, F)
        colors, depths, alphas = self._render_tissue(cameras, means, covars, F)
        if self._behind is not None and positions is not None:
            at, stretched = (torch.as_tensor(each, dtype=torch.float32, device=self.device) for each in (positions, F))
            self._behind.draw(cameras, at, stretched, (colors, depths, alphas), self._background)
        sees_tissue = (alphas[0] > SURFACE).any()
        marks = None
        if instruments is not None:
            marks = instruments.draw_into(cameras, colors, depths, alphas)
        elif labels:
            marks = (alphas > SURFACE).to(torch.uint8)
        found, light, lamp = [sees_tissue], light or self.model.light, lamp or cameras[0]
        for i, camera in enumerate(cameras):
            found.append(to_bytes(colors[i] if light is None else shade(light, colors[i], depths[i], alphas[i], camera, lamp)))
        if depth:
            found += torch.where(alphas > SURFACE, depths / alphas.clamp_min(1e-6), 0.0)
        if labels and marks is not None:
            found += marks
        sees, *arrays = download(*found)
        self.sees_tissue = bool(sees)
        count = len(cameras)
        images, rest, nothing = arrays[:count], arrays[count:], [None] * count
        distances = rest[:count] if depth else nothing
        return [View(*each) for each in zip(images, distances, rest[-count:] if labels else nothing, strict=True)]

    def opened(self, means: Tensor, rest: Tensor) -> GaussianModel:
        """Return the model with as much of its flesh as cuts have opened, at means [N, 3], and at rest [N, 3], m, world."""
        model, count = self.model, len(self._skin)
        if len(model) == count:
            return model
        share = open_share(rest[count:], means[count:], self.config.inside.grain)
        opacities = torch.cat([model.logit_opacities[:count], (model.opacities[count:] * share).logit()])
        return replace(model, logit_opacities=opacities)

    def _render_tissue(
        self, cameras: Sequence[Camera], means: Tensor, covars: Tensor | None, F: np.ndarray | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colours [E, H, W, 3], depths and alphas [E, H, W] of the tissue in each camera."""
        rest = means if covars is None or self.skinning is None else self.skinning.means  # which cuts that cross it have moved
        model = self.opened(means, rest)
        draw = partial(render, background=self._background, covars=covars)
        if covars is None:
            return draw(model, *cameras)[:3]
        assert self.skinning is not None and F is not None  # else there are no covariances
        moved = partial(replace, model, means=means)
        if model.reflects:
            return draw(moved(), *cameras, cosines=self.skinning.cosines(F, means, [camera.position for camera in cameras]))[:3]
        if not model.sh_degree:
            return draw(moved(), *cameras)[:3]
        # Each eye sees colours of its own.
        seen = [draw(moved(sh=turned_colors(model.sh, self.skinning, means, F, camera)), camera)[:3] for camera in cameras]
        if len(seen) == 1:
            return seen[0]
        colors, depths, alphas = map(torch.cat, zip(*seen))
        return colors, depths, alphas


@torch.no_grad()
def render_depth(model: GaussianModel, camera: Camera) -> np.ndarray:
    """Return the median depth [H, W] of a model at rest in a camera, float32, metres, 0 = no surface."""
    output = render(model, camera, median=True)
    assert output.medians is not None  # asked for
    return torch.where(output.alphas[0] > SURFACE, output.medians[0], 0.0).cpu().numpy()


def middle_depth(depth: np.ndarray) -> float | None:
    """Return the median depth in the middle of a depth image [H, W], m, or None where no surface is there."""
    rows, columns = (slice(side // 4, side - side // 4) for side in depth.shape)
    seen = depth[rows, columns][depth[rows, columns] > 0]
    return float(np.median(seen)) if seen.size else None


def turned_colors(sh: Tensor, skinning: Skinning, means: Tensor, F: Tensor | np.ndarray, camera: Camera) -> Tensor:
    """Return coefficients of degree 0 [N, 1, 3] of the colours that a camera sees, as view directions turn back with the tissue.

    Args:
        sh: Spherical harmonic coefficients [N, K, 3] of the Gaussians at rest.
        skinning: How the Gaussians follow the control nodes.
        means: Centres of the Gaussians now [N, 3], metres, world.
        F: Deformation gradients of the control nodes [M, 3, 3].
        camera: Where the Gaussians are seen from.
    """
    (position,) = upload(means.device, camera.position)
    directions = torch.nn.functional.normalize(means - position, dim=1)
    at_rest = torch.einsum("nij,ni->nj", skinning.rotations(F), directions)
    return (sh_basis(at_rest, sh.shape[1])[..., None] * sh).sum(1, keepdim=True) / SH_C0
