"""Instruments drawn into a picture of the tissue: what is nearer hides what is farther, both ways."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import Range, StageConfig
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.kernels import launch, launch_in_shares, load_kernels
from endo_sim_ros.instruments import drawing_kernels as kernels
from endo_sim_ros.instruments.shapes import Material, Part

BACKGROUND, TISSUE, FIRST_LINK = 0, 1, 2
"""Labels of pixels; links of the instruments follow in their order."""

SURFACES = {
    Material.STEEL: (0.20, 0.20, 0.21, 0.42, 0.42),
    Material.SHAFT: (0.035, 0.035, 0.038, 0.5, 0.10),
    Material.INSULATION: (0.20, 0.19, 0.17, 0.55, 0.10),
}
"""Red, green and blue at the model's reference distance, roughness, and strength of the shine; by eye beside real instruments."""

_CREASE = np.cos(np.radians(35))  # faces that meet at a smaller angle are one smooth surface
_NEAREST = 2e-3  # metres from the plane of the lens


@dataclass(frozen=True)
class DrawingConfig(StageConfig):
    """How instruments are lit and meet the tissue."""

    lamp_x: Annotated[float, Range(-0.05, 0.05, "m")] = 0.003
    """Where the lamp is beside the lens, to the right in the picture."""
    lamp_y: Annotated[float, Range(-0.05, 0.05, "m")] = -0.002
    """The same downwards."""
    ambient: Annotated[float, Range(0, 1)] = 0.12
    """Share of the light that comes from all around: wet tissue reflects much of the lamp's."""
    softness: Annotated[float, Range(1e-5, 0.01, "m")] = 4e-4
    """Depth over which an instrument comes out of the tissue; splats have no sharper surface."""


@dataclass(frozen=True)
class Picture:
    """What a camera sees, before light and exposure.

    Args:
        colors: [H, W, 3].
        depths: Σ w z [H, W], m.
        alphas: Σ w [H, W].
        labels: [H, W] uint8: 0 background, 1 tissue, 2 and up the links, in the order of `InstrumentDrawing.links`.
    """

    colors: Tensor
    depths: Tensor
    alphas: Tensor
    labels: Tensor


class InstrumentDrawing:
    """Draws instruments.

    Args:
        instruments: The parts of each.
        config: Options.
        device: Compute device.
    """

    def __init__(self, instruments: Sequence[Sequence[Part]], config: DrawingConfig = DrawingConfig(), device: str = "auto") -> None:
        self.config, self.device = config, pick_device(device)
        self.links = tuple(dict.fromkeys((i, part.link) for i, parts in enumerate(instruments) for part in parts))
        """The number of an instrument and the name of a link, in the order of the labels."""
        corners, normals, links, materials = [], [], [], []
        for i, parts in enumerate(instruments):
            for part in parts:
                corners.append(part.vertices[part.faces])
                normals.append(corner_normals(part))
                links += [self.links.index((i, part.link))] * len(part.faces)
                materials += [int(part.material)] * len(part.faces)
        move = lambda arrays, kind: torch.as_tensor(np.asarray(arrays), dtype=kind, device=self.device).contiguous()
        self._corners = move(np.concatenate(corners).reshape(-1, 3), torch.float32)
        self._normals = move(np.concatenate(normals).reshape(-1, 3), torch.float32)
        self._links, self._materials = move(links, torch.int32), move(materials, torch.int32)
        self._surfaces = move([SURFACES[material] for material in Material], torch.float32)
        self._screen, self._turned = torch.empty_like(self._corners), torch.empty_like(self._corners)
        self._samples = torch.empty(0, dtype=torch.int64, device=self.device)
        load_kernels((kernels,), self.device)

    def draw(self, poses: Sequence[Mapping[str, np.ndarray]], camera: Camera, colors: Tensor, depths: Tensor, alphas: Tensor) -> Picture:
        """The picture of the tissue with the instruments in it.

        Args:
            poses: Of each instrument the poses [4, 4] of its links, world.
            camera: What the tissue was rendered for.
            colors, depths, alphas: Rendered tissue [H, W, 3] and [H, W], before light and exposure.
        """
        K, width, height = camera.K, camera.width, camera.height
        view = kernels.View()
        view.fx, view.fy, view.cx, view.cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        view.width, view.height, view.nearest = width, height, _NEAREST
        look = kernels.Look()
        look.lamp, look.ambient, look.softness = (self.config.lamp_x, self.config.lamp_y, 0.0), self.config.ambient, self.config.softness
        local = np.stack([camera.viewmat @ poses[i][link] for i, link in self.links])
        local = torch.as_tensor(local, dtype=torch.float32, device=self.device)
        faces, pixels = len(self._links), width * height
        if len(self._samples) != pixels * int(kernels.SAMPLES):
            self._samples = torch.full((pixels * int(kernels.SAMPLES),), int(kernels.EMPTY), dtype=torch.int64, device=self.device)
        picture = Picture(colors.clone(), depths.clone(), alphas.clone(), torch.zeros(height, width, dtype=torch.uint8, device=self.device))
        flat = [
            x.reshape(-1) if x.ndim == 2 else x.reshape(-1, 3) for x in (picture.colors, picture.depths, picture.alphas, picture.labels)
        ]
        self._launch(kernels.project, 3 * faces, [self._corners, self._normals, self._links, local, view, self._screen, self._turned])
        if self.device == "cpu":
            launch_in_shares(
                kernels.cover_rows, -(-height // int(kernels.BLOCK)), [faces, self._screen, view, self._samples, flat[3]], least=4
            )
        else:
            self._launch(kernels.cover_faces, faces, [faces, self._screen, view, self._samples, flat[3]])
        scene = [self._samples, self._screen, self._turned, self._links, self._materials, self._surfaces, view, look]
        self._launch(kernels.resolve, pixels, [*scene, *flat])
        return picture

    def _launch(self, kernel: object, count: int, arguments: list) -> None:
        if self.device == "cpu":
            launch_in_shares(kernel, count, arguments)
        else:
            launch(kernel, count, [0, *arguments], self.device)


def corner_normals(part: Part) -> np.ndarray:
    """Normals [F, 3, 3] at the corners of each face: the mean of the faces around that lie about as it does."""
    corners = part.vertices[part.faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # as long as the face is large
    unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-20)
    order = np.argsort(part.faces.ravel(), kind="stable")
    bounds = np.searchsorted(part.faces.ravel()[order], np.arange(len(part.vertices) + 1))
    normals = np.empty((len(part.faces), 3, 3))
    for first, last in zip(bounds[:-1], bounds[1:]):
        at = order[first:last]
        around = at // 3
        alike = unit[around] @ unit[around].T > _CREASE
        normals[around, at % 3] = alike @ across[around]
    return normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-20)
