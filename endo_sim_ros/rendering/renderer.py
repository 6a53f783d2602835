"""Images and depth of a Gaussian model, at rest or as it follows its control nodes, in a camera."""

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import download, pick_device, single_threaded_torch, split, upload_flat
from endo_sim_ros.core.dye import DyedSpot, dyed_model
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.growing import Growing
from endo_sim_ros.core.light import SURFACE, Light
from endo_sim_ros.core.shading import Shading, to_bytes
from endo_sim_ros.core.surroundings import fill_holes
from endo_sim_ros.instruments.drawing import InstrumentDrawing, PosedInstruments
from endo_sim_ros.physics.skinning import Skinning
from endo_sim_ros.rendering.behind import Behind
from endo_sim_ros.rendering.config import RenderingConfig
from endo_sim_ros.rendering.inside import Inside, open_share
from endo_sim_ros.splatting import camera_arrays, render, render_from, sh_basis
from endo_sim_ros.splatting.graph_capture import GraphCapture

_NO_NODES = "this renderer has no control nodes and shows the model at rest only; give it node_rest"
LEAST_TISSUE = 0.01  # share of the pixels: less is a speck, as a camera far away sees
_WORKS = 8  # kinds of pictures whose work is kept, such as those of viewers of several sizes


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
        sees_tissue: Whether the newest image shows any, in `LEAST_TISSUE` of its pixels.

    Raises:
        ValueError: If the device is not there, there are no nodes, or positions are not finite.
    """

    def __init__(self, model: GaussianModel, node_rest: np.ndarray | None, config: RenderingConfig) -> None:
        self.device = pick_device(config.device)
        self.model = model.detach().to(self.device)
        self.config = config
        self.sees_tissue = True
        self._background = torch.full((3,), max(config.background, 0.0), device=self.device)
        self.skinning: Skinning | None = None
        if node_rest is not None:
            options: dict[str, Any] = {"neighbours": config.neighbours, "weighting": config.skinning, "device": self.device}
            if not config.clamp_stretch:
                options["stretch"] = None
            self.skinning = Skinning(self.model, node_rest, **options)
        self._skin = self._undyed = self.model
        self._grown: dict[str, Growing[Tensor]] = {}  # the tensors of the model, from the first flesh on
        self._blood = Growing(torch.zeros(0, dtype=torch.bool, device=self.device))  # which of the flesh counts also where cuts are closed
        self._inside: Inside | None = None  # from the first cut on
        self._behind: Behind | None = None
        self._works: dict[tuple, Callable[..., list[Tensor]]] = {}  # those of the newest pictures
        if self.skinning is not None and config.behind.shown:
            self._behind = Behind(self.model, self.skinning, config.behind)

    @single_threaded_torch()
    def cut(self, triangles: np.ndarray) -> None:
        """Part the tissue along all cuts so far, triangles [T, 3, 3], metres, world, in the tissue at rest, and show flesh where it opens.

        The Gaussians of the flesh follow those of the skin in `model`.
        """
        if self.skinning is None or np.array_equal(triangles, self.skinning.cuts):
            return
        self._works.clear()
        known = len(self.skinning.cuts)
        if not self.skinning.cut(triangles):
            self.model, self._grown, known = self._skin, {}, 0
            self._blood.shorten(0)
            for each in (self._inside, self._behind):
                if each is not None:
                    each.heal()
        new = triangles[known:]
        if not len(new):
            return
        if not self.config.inside.shown:
            if self._behind is not None:
                self._behind.cut(new, None)
            return
        if self._inside is None:
            # Dye is on the skin alone, and may be elsewhere when cuts have healed.
            self._inside = Inside(self._undyed, self.skinning.node_rest.cpu().double().numpy(), self.config.inside)
        if self._behind is not None:
            self._behind.cut(new, self._inside)
        flesh, blood = self._inside.faces(new)
        if len(flesh):
            flesh = flesh.to(self.device)
            self._blood.append(torch.from_numpy(blood).to(self.device))
            self.skinning.append(flesh)
            self._grown = self._grown or {name: Growing(value) for name, value in self.model.tensors().items()}
            self.model = replace(self.model, **{name: each.append(getattr(flesh, name)) for name, each in self._grown.items()})

    def dye(self, spots: Sequence[DyedSpot]) -> None:
        """Show the tissue with these spots of dye, and no others."""
        self._works.clear()
        self._skin = dyed_model(self._undyed, spots)
        own, count = self._skin.tensors(), len(self._skin)
        names = own.keys() & {"sh", "bared"}
        self.model = replace(self.model, **{name: torch.cat([own[name], getattr(self.model, name)[count:]]) for name in names})
        self._grown = {}

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
            raise ValueError(_NO_NODES)
        return self.skinning.deform(positions, F)

    def bared(self, model: GaussianModel, F: np.ndarray | Tensor) -> GaussianModel:
        """Return the model with the colours that its Gaussians have where control nodes are deformed by F [M, 3, 3]."""
        if model.bared is None or self.skinning is None:
            return model
        strains = self.skinning.strains(torch.as_tensor(F, device=self.device))
        return replace(model, sh=bared_colors(model.sh, model.bared, strains, self.config.bared_strain))

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

        Light, exposure and tone curve come after the instruments, so that they count in all of them.

        Args:
            cameras: One, or one for each eye, all of one size.
            positions, F, light: As for `render`.
            depth, labels: Whether to return these; None otherwise.
            instruments: What is drawn beside the tissue, on the device of the renderer; None = nothing.
            lamp: A camera where the lamp is; None: the first of the cameras.

        Raises:
            ValueError: As from `render`.
        """
        if positions is not None and F is None:
            raise ValueError("render: positions of control nodes go with their deformation gradients F; F is None")
        if positions is not None and self.skinning is None:
            raise ValueError(_NO_NODES)
        state = [] if positions is None or F is None else [np.asarray(positions), np.asarray(F)]
        light, lamp = light or self.model.light, lamp or cameras[0]
        drawn = [] if instruments is None else instruments.arrays(cameras, light)
        arrays = [*camera_arrays(cameras), *state, *drawn]
        shadings = [] if light is None else [Shading(light, camera, self.device, lamp) for camera in cameras]
        size = cameras[0].width, cameras[0].height
        drawing = None if instruments is None else instruments.drawing
        key = size, *(array.shape for array in arrays), *(shading.key for shading in shadings), id(drawing), depth, labels
        draw = self._works.pop(key, None)
        if draw is None:
            frame = None if drawing is None else drawing.frame(len(cameras), *size)
            shapes = [array.shape for array in arrays]
            work = _Work(weakref.proxy(self), size, shapes, shadings, drawing, frame, bool(state), depth, labels)
            draw = work if self.device == "cpu" else GraphCapture(work)
            while len(self._works) >= _WORKS:
                del self._works[next(iter(self._works))]
        self._works[key] = draw  # the newest comes last
        sees, *found = download(*draw(upload_flat(self.device, *arrays)))
        self.sees_tissue = bool(sees)
        count = len(cameras)
        images, rest, nothing = found[:count], found[count:], [None] * count
        distances = rest[:count] if depth else nothing
        return [View(*each) for each in zip(images, distances, rest[-count:] if labels else nothing, strict=True)]

    @single_threaded_torch()
    @torch.no_grad()
    def prepare(self) -> None:
        """Make ready for more pictures like the newest ones; on a GPU the second of each kind takes 10 ms longer otherwise."""
        for draw in self._works.values():
            if isinstance(draw, GraphCapture):
                draw.prepare()

    def opened(self, means: Tensor, rest: Tensor) -> GaussianModel:
        """Return the model with as much of its flesh as cuts have opened, at means [N, 3], and at rest [N, 3], m, world."""
        model, count = self.model, len(self._skin)
        if len(model) == count:
            return model
        share = open_share(rest[count:], means[count:], self.config.inside.grain).masked_fill(self._blood.rows, 1.0)
        opacities = torch.cat([model.logit_opacities[:count], (model.opacities[count:] * share).logit()])
        return replace(model, logit_opacities=opacities)

    def _draw_tissue(self, matrices: Sequence[Tensor], size: tuple[int, int], state: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Colours [E, H, W, 3], depths and alphas [E, H, W] of the tissue, and of what is behind it.

        Args:
            matrices: Of E cameras, on the device, as `camera_arrays` has them.
            size: Width and height of the pictures, pixels.
            state: Positions of the control nodes [M, 3], m, world, and their F [M, 3, 3]; nothing: at rest.
        """
        skinning, means, covars, seen = self.skinning, self.model.means, None, None
        draw = partial(render_from, width=size[0], height=size[1], background=self._background)
        if not state or skinning is None:
            return draw(self.opened(means, means), *matrices)[:3]
        positions, F = state
        means, covars = skinning.deform(positions, F)
        model = replace(self.opened(means, skinning.means), means=means)  # cuts that cross Gaussians have moved them at rest, too
        model = self.bared(model, F)
        if model.reflects:
            seen = skinning.seen(F, means, matrices[2], model.sh)
        if model.reflects or not model.sh_degree:
            pictures = [draw(model, *matrices, covars=covars, seen=seen)[:3]]
        else:  # each eye sees colours of its own
            eyes = zip(*(each.split(1) for each in matrices))
            own_colors = ((replace(model, sh=turned_colors(model.sh, skinning, means, F, eye[2])), eye) for eye in eyes)
            pictures = [draw(own, *eye, covars=covars)[:3] for own, eye in own_colors]
        colors, depths, alphas = pictures[0] if len(pictures) == 1 else map(torch.cat, zip(*pictures))
        if self._behind is not None:
            self._behind.draw(matrices, positions, F, (colors, depths, alphas), self._background)
        return colors, depths, alphas


@dataclass(frozen=True)
class _Work:
    """What is done for all pictures that differ only in where cameras, control nodes and instruments are: on a GPU it is captured.

    Args:
        renderer: What it is for; not to be cut or dyed meanwhile. A weak reference, as the renderer keeps this.
        size: Width and height of the pictures, pixels.
        shapes: Of the arrays that it takes.
        shadings: Of each eye; none: no light.
        drawing: What draws instruments, if any, and in what `frame`.
        deformed: Whether tissue follows its control nodes.
        depth, labels: What is asked for.
    """

    renderer: DeformableRenderer
    size: tuple[int, int]
    shapes: Sequence[tuple[int, ...]]
    shadings: Sequence[Shading]
    drawing: InstrumentDrawing | None
    frame: Any
    deformed: bool
    depth: bool
    labels: bool

    def __call__(self, flat: Tensor) -> list[Tensor]:
        """Whether tissue is seen, the image of each eye as bytes [H, W, 3], and its depth and labels [H, W] where they are asked for.

        Args:
            flat: Matrices of the cameras, the state of the control nodes, and the arrays of the drawing: all in one, as each more that a
                capture takes costs a launch.
        """
        arrays = split(flat, self.shapes)
        matrices, state, drawn = arrays[:3], arrays[3 : 3 + 2 * self.deformed], arrays[3 + 2 * self.deformed :]
        colors, depths, alphas = self.renderer._draw_tissue(matrices, self.size, state)
        found, marks = [(alphas[0, ::4, ::4] > SURFACE).float().mean() >= LEAST_TISSUE], None  # a sixteenth of the pixels tells
        if self.drawing is not None:
            marks = self.drawing.draw_arrays(self.frame, drawn, colors, depths, alphas)
        elif self.labels:
            marks = (alphas > SURFACE).to(torch.uint8)
        if self.shadings:
            colors = [shading(*picture) for shading, *picture in zip(self.shadings, colors, depths, alphas)]
        if self.renderer.config.background < 0 and self.shadings and self.shadings[0].light.filled:
            for each, alpha in zip(colors, alphas):
                fill_holes(each[None], alpha[None])
        found += [to_bytes(each) for each in colors]
        if self.depth:
            found += torch.where(alphas > SURFACE, depths / alphas.clamp_min(1e-6), 0.0)
        if self.labels and marks is not None:
            found += marks
        return found


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


def bared_colors(sh: Tensor, bared: Tensor, strains: Tensor, whole: float) -> Tensor:
    """Return coefficients [..., N, K, 3] of colours in strained tissue, where what others hid at rest may be seen.

    Args:
        sh: Those at rest [N, K, 3], or [..., N, K, 3].
        bared: What is added to the first of them in tissue that is strained wholly [N, 3], or [..., N, 3].
        strains: What `Skinning.strains` returned [..., N].
        whole: Strain from which on tissue is strained wholly; the share grows with its square, so that breath shows next to nothing.
    """
    share = (strains / whole).clamp_max(1).square()[..., None, None]
    base = sh[..., :1, :] + share * bared[..., None, :]
    return base if sh.shape[-2] == 1 else torch.cat([base, sh[..., 1:, :].expand(*share.shape[:-2], -1, -1)], -2)


def turned_colors(sh: Tensor, skinning: Skinning, means: Tensor, F: Tensor | np.ndarray, eye: Tensor) -> Tensor:
    """Return coefficients of degree 0 [N, 1, 3] of the colours that an eye sees, as view directions turn back with the tissue.

    Args:
        sh: Spherical harmonic coefficients [N, K, 3] of the Gaussians at rest.
        skinning: How the Gaussians follow the control nodes.
        means: Centres of the Gaussians now [N, 3], metres, world.
        F: Deformation gradients of the control nodes [M, 3, 3].
        eye: Where the Gaussians are seen from [3] or [1, 3], m, world.
    """
    directions = torch.nn.functional.normalize(means - eye, dim=1)
    at_rest = torch.einsum("nij,ni->nj", skinning.rotations(F), directions)
    return (sh_basis(at_rest, sh.shape[1])[..., None] * sh).sum(1, keepdim=True) / SH_C0
