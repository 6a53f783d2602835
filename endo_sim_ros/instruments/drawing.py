"""Instruments drawn into a picture of the tissue: what is nearer hides what is farther, both ways."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import pick_device, upload
from endo_sim_ros.core.kernels import launch, launch_in_shares, load_kernels, vectorised
from endo_sim_ros.core.light import Light
from endo_sim_ros.instruments import drawing_kernels, light_kernels, resolving_kernels
from endo_sim_ros.instruments.config import DrawingConfig as DrawingConfig
from endo_sim_ros.instruments.shapes import Capsule, Material, Part

BACKGROUND, TISSUE, FIRST_LINK = 0, 1, 2
"""Labels of pixels; links of the instruments follow in their order."""

SURFACES = {
    Material.STEEL: (0.006, 0.006, 0.006, 0.42, 0.58),
    Material.SHAFT: (0.002, 0.002, 0.0023, 0.55, 0.03),
    Material.INSULATION: (0.04, 0.036, 0.029, 0.6, 0.03),
    Material.VESSEL: (0.34, 0.075, 0.06, 0.42, 0.04),
    Material.DYE: (0.008, 0.05, 0.28, 0.42, 0.04),
    Material.CLIP: (0.42, 0.36, 0.55, 0.5, 0.04),
}
"""Red, green and blue of what is scattered, roughness, and share of light that is mirrored; by eye beside real instruments."""

_NEAREST = 2e-3  # metres from the plane of the lens


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


@dataclass(frozen=True)
class PosedInstruments:
    """Instruments at one moment.

    Args:
        drawing: What draws them.
        poses: Of each the poses [4, 4] of its links, world, m.
    """

    drawing: "InstrumentDrawing"
    poses: Sequence[Mapping[str, np.ndarray]]

    def arrays(self, cameras: Sequence[Camera], light: Light | None = None) -> list[np.ndarray]:
        """What `InstrumentDrawing.draw_arrays` takes to draw them into pictures of the eyes of one endoscope, whose lamp is beside the
        first; ``light`` is as for `InstrumentDrawing.draw`."""
        drawing, config = self.drawing, self.drawing.config
        viewmats = np.array([camera.viewmat for camera in cameras])
        lamps = viewmats @ (cameras[0].pose @ np.array([config.lamp_x, config.lamp_y, 0.0, 1.0]))
        local = viewmats[:, None] @ np.array([self.poses[i][link] for i, link in drawing.links])
        return drawing.arrays(local, lenses(cameras), lamps[:, :3], light=light)


class InstrumentDrawing:
    """Draws instruments.

    Args:
        instruments: The parts of each.
        config: Options.
        device: Compute device.
        capsules: The capsules of each. They throw shadows, and tell which way metal is brushed and where the gaps of joints are; without
            them there is none of it.

    Raises:
        ValueError: If more than 64 capsules would throw shadows.
    """

    def __init__(
        self,
        instruments: Sequence[Sequence[Part]],
        config: DrawingConfig = DrawingConfig(),
        device: str = "auto",
        capsules: Sequence[Sequence[Capsule]] = (),
    ) -> None:
        self.config, self.device = config, pick_device(device)
        named = [[(i, part.link) for part in parts] for i, parts in enumerate(instruments)]
        bones = [(i, bone) for i, parts in enumerate(instruments) for part in parts for bone in part.bones]
        self.links = tuple(dict.fromkeys([*chain(*named), *bones]))
        """The number of an instrument and the name of a link, in the order of the labels; those that are bones alone come last."""
        numbers = {link: number for number, link in enumerate(self.links)}
        corners, normals, links, moved, materials = [], [], [], [], []
        for i, parts in enumerate(instruments):
            for part in parts:
                corners.append(part.vertices[part.faces])
                normals.append(part.corner_normals)
                links += [numbers[i, part.link]] * len(part.faces)
                own = np.array([numbers[i, bone] for bone in part.bones or [part.link] * len(part.vertices)])
                moved.append(own[part.faces].ravel())
                materials += [int(part.material)] * len(part.faces)
        move = lambda arrays, kind: torch.as_tensor(np.asarray(arrays), dtype=kind, device=self.device).contiguous()
        self._fixed = {
            "corners": move(np.concatenate(corners).reshape(-1, 3), torch.float32),
            "normals": move(np.concatenate(normals).reshape(-1, 3), torch.float32),
            "face_links": move(links, torch.int32),
            "corner_links": move(np.concatenate(moved), torch.int32),
            "materials": move(materials, torch.int32),
            "owners": move([self.links[link][0] for link in links], torch.int32),
        }
        self._surfaces = np.array([SURFACES[material] for material in Material])
        known = [(i, capsule) for i, own in enumerate(capsules) for capsule in own]
        if config.shadows and len(known) > int(resolving_kernels.MOST):
            raise ValueError(f"{len(known)} capsules throw shadows, and at most {int(resolving_kernels.MOST)} can; draw fewer instruments")
        ends = np.array([((*capsule.start, 1.0), (*capsule.end, 1.0)) for _, capsule in known]).reshape(-1, 2, 4)
        self._ends = ends.swapaxes(1, 2)  # [C, 4, 2] m, in the frame of the link
        self._capsule_links = np.array([numbers[i, capsule.link] for i, capsule in known], int)
        self._fixed["capsule_owners"] = move([i for i, _ in known], torch.int32)
        self._fixed["radii"] = move([capsule.radius for _, capsule in known], torch.float32)
        self._look = look = resolving_kernels.Look()
        look.ambient, look.softness = config.ambient, config.softness
        look.lamp_size, look.mirror = config.lamp_size, config.mirror
        self._newest: tuple[int, tuple[int, int, bool], Any] = 0, (0, 0, False), None
        load_kernels((drawing_kernels, light_kernels, resolving_kernels), self.device)

    def at(self, poses: Sequence[Mapping[str, np.ndarray]]) -> PosedInstruments:
        """The instruments where the poses [4, 4] of their links, world, put them."""
        return PosedInstruments(self, poses)

    def draw(
        self,
        poses: Sequence[Mapping[str, np.ndarray]],
        camera: Camera,
        colors: Tensor,
        depths: Tensor,
        alphas: Tensor,
        light: Light | None = None,
    ) -> Picture:
        """The picture of the tissue with the instruments in it.

        Args:
            poses: Of each instrument the poses [4, 4] of its links, world.
            camera: What the tissue was rendered for.
            colors, depths, alphas: Rendered tissue [H, W, 3] and [H, W], before light and exposure.
            light: What `core.shading` lights the picture with. It lights a pixel at an outline for one depth, whereas colours of two blend
                there: the other's is as much darker or brighter before. None: nothing lights it.
        """
        colors, depths, alphas = colors.clone()[None], depths.clone()[None], alphas.clone()[None]
        labels = self.draw_into([poses], [camera], colors, depths, alphas, light=light)
        return Picture(colors[0], depths[0], alphas[0], labels[0])

    def draw_into(
        self,
        poses: Sequence[Sequence[Mapping[str, np.ndarray]]],
        cameras: Sequence[Camera],
        colors: Tensor,
        depths: Tensor,
        alphas: Tensor,
        lamps: np.ndarray | None = None,
        light: Light | None = None,
    ) -> Tensor:
        """Draw the instruments into B pictures at once, such as those of two eyes or of as many copies of a scene.

        Args:
            poses: For each picture of each instrument the poses [4, 4] of its links, world.
            cameras: What each was rendered for, all of one size.
            colors, depths, alphas: Rendered tissue [B, H, W, 3] and [B, H, W], contiguous; the instruments come into them.
            lamps: Where the lamp of each is in its camera [B, 3], m; that of the options by default.
            light: As for `draw`.

        Returns:
            Labels [B, H, W], uint8, as in `Picture`.
        """
        world = np.array([[own[i][link] for i, link in self.links] for own, _ in zip(poses, cameras, strict=True)])
        viewmats = np.array([camera.viewmat for camera in cameras])
        return self.draw_links(viewmats[:, None] @ world, lenses(cameras), colors, depths, alphas, lamps, light=light)

    def draw_links(
        self,
        local: np.ndarray,
        lenses: np.ndarray,
        colors: Tensor,
        depths: Tensor,
        alphas: Tensor,
        lamps: np.ndarray | None = None,
        surfaces: np.ndarray | None = None,
        light: Light | None = None,
    ) -> Tensor:
        """Draw the instruments into B pictures at once, as `draw_into`, from arrays.

        Args:
            local: Poses [B, L, 4, 4] in the camera of each picture of all `links` in their order.
            lenses: fx, fy, cx, cy of each [B, 4], pixels.
            colors, depths, alphas, lamps, light: As for `draw_into`.
            surfaces: What the materials of each are like [B, M, 5], as `SURFACES`; those by default.
        """
        count, (height, width) = len(local), colors.shape[1:3]
        uploaded = upload(self.device, *self.arrays(local, lenses, lamps, surfaces, light))
        return self.draw_arrays(self.frame(count, width, height, surfaces is not None), uploaded, colors, depths, alphas)

    def arrays(
        self,
        local: np.ndarray,
        lenses: np.ndarray,
        lamps: np.ndarray | None = None,
        surfaces: np.ndarray | None = None,
        light: Light | None = None,
    ) -> list[np.ndarray]:
        """The numbers that `draw_arrays` takes, once they are on the device; arguments are those of `draw_links`."""
        if lamps is None:
            lamps = np.array([self.config.lamp_x, self.config.lamp_y, 0.0])
        ends = (local[:, self._capsule_links] @ self._ends)[:, :, :3].swapaxes(2, 3)  # [B, C, 2, 3]
        distance, shoulder = (light.distance, light.shoulder) if light else (0.0, 0.0)
        views = np.empty((len(local), 9))
        views[:, :4], views[:, 4:7], views[:, 7] = lenses, lamps, distance
        views[:, 8] = self.config.white * (1 + shoulder)  # see `core.light.toned`
        return [local, ends, views, self._surfaces if surfaces is None else surfaces]

    def draw_arrays(self, frame: Any, arrays: Sequence[Tensor], colors: Tensor, depths: Tensor, alphas: Tensor) -> Tensor:
        """Draw the instruments as `draw_links` does, in a `frame`, from `arrays` that are on the device."""
        placed, ends, views, materials = arrays
        count, height, width = alphas.shape
        on_host, in_vectors = torch.device(self.device).type == "cpu", vectorised(self.device)
        labels = torch.empty_like(alphas, dtype=torch.uint8)
        lanes, tile = 1 if on_host else light_kernels.LANES, int(drawing_kernels.TILE)
        scene = [materials, ends, views, frame, self._look, colors, depths, alphas, labels]
        work = [
            (light_kernels.sum_light, count * lanes, [lanes, frame, colors, depths, alphas]),
            (drawing_kernels.project, count * frame.faces, [placed, views, frame]),
        ]
        if in_vectors:
            work.append((drawing_kernels.cover_rows, count * frame.down, [frame]))
            work.append((resolving_kernels.resolve_tiles, count * frame.across * frame.down, scene))
        else:
            work.append((drawing_kernels.cover_faces, count * frame.faces * frame.lanes, [frame]))
            work.append((resolving_kernels.resolve_blocks, count * frame.across * frame.down * tile**2, scene))
        for kernel, items, arguments in work:
            if on_host:
                launch_in_shares(kernel, items, arguments, least=4)
            else:
                launch(kernel, items, [0, *arguments], self.device)
        return labels

    def frame(self, count: int, width: int, height: int, own_surfaces: bool = False) -> Any:
        """What kernels draw into B pictures of a size with; the same object as before if it will do, so that launches are known again."""
        key = width, height, own_surfaces
        most, known, frame = self._newest
        if known == key and count <= most:
            return frame
        frame, tile = drawing_kernels.Frame(), int(drawing_kernels.TILE)
        frame.width, frame.height, frame.across, frame.down = width, height, -(-width // tile), -(-height // tile)
        frame.faces, frame.links, frame.capsules = (len(x) for x in (self._fixed["face_links"], self.links, self._fixed["radii"]))
        frame.several, frame.spread, frame.nearest = int(len({i for i, _ in self.links}) > 1), self.config.blur, _NEAREST
        frame.shadows = int(self.config.shadows and frame.capsules > 0)
        frame.stride = _stride(frame.down)
        frame.surfaces = len(Material) if own_surfaces else 0
        frame.lanes = 2 * -(-height // int(drawing_kernels.APART))  # with half as many, all wait for those of a shaft
        new = lambda shape, kind, value=0: torch.full(shape, value, dtype=kind, device=self.device)
        triangles, pixels = count * frame.faces, count * width * height
        arrays = self._fixed | {
            "around": new((count, 3), torch.float32),
            "cells": new((count * int(drawing_kernels.CELLS) ** 2, 4), torch.float32),
            "screen": new((3 * triangles, 3), torch.float32),
            "turned": new((3 * triangles, 3), torch.float32),
            "rows": new((triangles, 2), torch.int32),
            "samples": new((pixels * int(drawing_kernels.SAMPLES),), torch.int64, int(drawing_kernels.EMPTY)),
            "middles": new((pixels,), torch.int32),
            "marks": new((count * frame.across * frame.down,), torch.uint8),
        }
        for name, array in arrays.items():
            setattr(frame, name, wp.from_torch(array, dtype=drawing_kernels.Frame.vars[name].type.dtype))
        self._newest = count, key, frame
        return frame


def lenses(cameras: Sequence[Camera]) -> np.ndarray:
    """fx, fy, cx, cy [B, 4] of cameras, pixels."""
    return np.array([camera.K for camera in cameras])[:, (0, 1, 0, 1), (0, 1, 2, 2)]


def _stride(count: int) -> int:
    """A step near the golden section of a count that has no factor in common with it, so that steps visit everything once."""
    step = max(int(0.618 * count), 1)
    while math.gcd(step, count) > 1:
        step += 1
    return step
