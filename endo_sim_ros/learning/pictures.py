"""What the endoscope shows of B episodes: the tissue as it is now and the tool in it, for both eyes and as labels."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import download, upload
from endo_sim_ros.core.dye import DyedSpot, dyed
from endo_sim_ros.core.light import SURFACE
from endo_sim_ros.core.reflections import seen_colors
from endo_sim_ros.core.shading import shade, to_bytes
from endo_sim_ros.instruments import LINKS, Material
from endo_sim_ros.instruments.config import DrawingConfig
from endo_sim_ros.instruments.drawing import FIRST_LINK, SURFACES, InstrumentDrawing, lenses
from endo_sim_ros.learning.config import Randomisation, SightConfig
from endo_sim_ros.learning.held_tools import HeldTools
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.tasks import Task
from endo_sim_ros.learning.variation import Variation
from endo_sim_ros.physics import Skinning, TissueBatch
from endo_sim_ros.rendering import turned_colors
from endo_sim_ros.splatting import rasterize

IMAGE, IMAGE_RIGHT, SEGMENTATION = "image", "image_right", "segmentation"
"""Names of the pictures."""

_ROUGHNESS = 0.1, 1.0  # smoother metal would be a mirror, which the drawing has none of
_AT_ONCE = 64  # images rasterised together, and on a CPU drawn into


@dataclass
class _View:
    """How one episode is seen."""

    cameras: tuple[Camera, ...]  # of each eye
    light: np.ndarray | None = None  # [H, W, 1] factor, None = 1
    contrast: float = 1.0  # factor on the colours' coefficients
    lamps: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # [E, 3] m, in the camera of each eye
    metal: np.ndarray = field(default_factory=lambda: np.ones(2))  # factors on what surfaces give back and on their roughness


class Pictures:
    """Draws B episodes.

    Args:
        scene: What is seen.
        tissue: How it moves.
        task: What is done there in B episodes.
        sight: What is shown.
        randomisation: How episodes differ.
        held: The tools, or None where pictures show the tissue alone.
    """

    def __init__(
        self, scene: Scene, tissue: TissueBatch, task: Task, sight: SightConfig, randomisation: Randomisation, held: HeldTools | None
    ):
        self._sight, self._by, self._held, self._task, self._count = sight, randomisation, held, task, (count := task.count)
        camera, nodes = scene.camera, tissue.nodes
        self.camera = camera.resized(sight.image_width, max(round(camera.height * sight.image_width / camera.width), 1))
        self._device = device = tissue.solver.device
        self._model = scene.model.detach().to(device)
        self._tissue = tissue
        self._sh = self._model.sh.expand(count, -1, -1, -1).clone() if sight.dye else None  # of each episode
        self._skinning = Skinning(self._model, nodes.rest, device=device)
        self._means, self._covars = tissue.append_skinning(self._skinning)
        self._pinned = torch.from_numpy(nodes.pinned).to(device)[:, None, None]
        self._thing = [thing] if (thing := task.thing()) else []
        shapes = [[*(tool.shape for tool in tools), *self._thing] for tools in held.kinds] if held else []
        self._drawings = [
            InstrumentDrawing([parts for parts, _ in own], device=device, capsules=[capsules for _, capsules in own]) for own in shapes
        ]
        self._tables = [torch.from_numpy(_labels(drawing)).to(device) for drawing in self._drawings]
        self._at_once = _AT_ONCE if torch.device(device).type == "cpu" else max(count, 1)
        options = DrawingConfig()
        self._lamp = np.array([options.lamp_x, options.lamp_y, 0.0, 1.0])  # m, camera
        self._surfaces = np.array([SURFACES[material] for material in Material])  # [M, 5]
        self._lens = lenses([self.camera])
        # What each picture needs in arrays, as it changes with episodes, not with steps.
        self._viewmats = np.zeros((sight.eyes, count, 4, 4))
        self._lamps = np.zeros((sight.eyes, count, 3))  # m, in the camera of each eye
        self._views = [self._view(None)] * count
        for b in range(count):
            self._show(b, self._views[b])

    def reset(self, episodes: Tensor, variations: Sequence[Variation], spots: Sequence[Sequence[DyedSpot]]) -> None:
        """Show these episodes [n] at rest, each with its variation and its dyed spots."""
        for b, variation, marked in zip(episodes.tolist(), variations, spots):
            self._show(b, self._view(variation))
            if self._sh is not None:
                self._sh[b] = dyed(self._model.sh, self._model.means, marked)
        self._means[episodes], self._covars[episodes] = self._skinning.means, self._skinning.covars
        if self._tissue.solver.motion.moving:
            positions = self._tissue.positions()
            for b in episodes.tolist():
                self._means[b], self._covars[b] = self._skinning.deform(positions[b], self._tissue.F[b])

    def _show(self, b: int, view: _View) -> None:
        self._views[b], self._lamps[:, b] = view, view.lamps
        self._viewmats[:, b] = [camera.viewmat for camera in view.cameras]

    @torch.no_grad()
    def draw(self, right: bool = False, labels: bool = False) -> dict[str, np.ndarray]:
        """What the endoscope sees of all episodes: ``image`` and ``image_right`` [B, H, W, 3], ``segmentation`` [B, H, W, 1], uint8.

        Args:
            right: Whether the right eye's are wanted.
            labels: Whether labels are: 0 background, 1 tissue, and then the links of the instruments in the order of `LINKS`, those of
                PSM2 after those of PSM1, and the thing of the task.
        """
        parts = [
            self._render(np.arange(i, min(i + self._at_once, self._count)), right, labels) for i in range(0, self._count, self._at_once)
        ]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _render(self, own: np.ndarray, right: bool, labels: bool) -> dict[str, np.ndarray]:
        eyes, views = range(1 + right), [self._views[b] for b in own]
        seen = [self._rasterize(own[i : i + _AT_ONCE], eye) for eye in eyes for i in range(0, len(own), _AT_ONCE)]
        colors, depths, alphas = seen[0] if len(seen) == 1 else map(torch.cat, zip(*seen))
        if self._held is not None:
            marks = self._draw_tools(self._held, own, len(eyes), (colors, depths, alphas))
        else:
            marks = (alphas > SURFACE).to(torch.uint8)
        if self._model.light is not None:
            cameras = [view.cameras[eye] for eye in eyes for view in views]
            colors = torch.stack([shade(self._model.light, *picture) for picture in zip(colors, depths, alphas, cameras)])
        if self._by.light:
            one = np.ones((1, 1, 1), np.float32)
            factors = [np.broadcast_to(one if view.light is None else view.light, (*colors.shape[1:3], 1)) for view in views]
            colors = colors * upload(self._device, np.array(factors * len(eyes)))[0]
        images, *rest = download(to_bytes(colors), *([marks[: len(own), ..., None]] if labels else []))
        found: dict[str, np.ndarray] = dict(zip((IMAGE, IMAGE_RIGHT), np.split(images, len(eyes))))
        if labels:
            (found[SEGMENTATION],) = rest
        return found

    def _rasterize(self, own: np.ndarray, eye: int) -> tuple[Tensor, Tensor, Tensor]:
        rows = slice(own[0], own[-1] + 1)
        viewmats, Ks = upload(self._device, self._viewmats[eye, rows], np.array([self.camera.K] * len(own)))
        seen = rasterize(
            self._means[rows], None, None, self._model.opacities, self._colors(rows, eye), viewmats, Ks,
            self.camera.width, self.camera.height, covars=self._covars[rows],
        )  # fmt: skip
        return seen.colors, seen.depths, seen.alphas

    def _colors(self, rows: slice, eye: int) -> Tensor:
        """Colours of all these episodes [N, K, 3], or of each [b, N, K, 3], as `rasterize` takes them."""
        views, sh = self._views[rows], self._model.sh if self._sh is None else self._sh[rows]
        if self._model.reflects or self._model.sh_degree:
            F = torch.where(self._pinned, torch.eye(3, device=sh.device), self._tissue.F[rows])  # as on control_nodes
        if self._model.reflects:
            positions = [view.cameras[eye].position for view in views]
            sh = seen_colors(self._model, self._skinning.cosines(F, self._means[rows], positions), sh)
        elif self._model.sh_degree:
            own = sh.expand(len(views), *sh.shape[-3:])
            each = zip(own, self._means[rows], F, (view.cameras[eye] for view in views))
            sh = torch.stack([turned_colors(own, self._skinning, means, F, camera) for own, means, F, camera in each])
        if self._by.texture:
            sh = sh * sh.new_tensor([view.contrast for view in views])[:, None, None, None]
        return sh

    def _draw_tools(self, held: HeldTools, own: np.ndarray, eyes: int, pictures: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Draw the tools into the colours, depths and alphas of these episodes, eye after eye; returns their labels [E b, H, W]."""
        which = held.kind(own)
        viewmats, lamps = (each[:eyes, own].reshape(-1, *each.shape[2:]) for each in (self._viewmats, self._lamps))
        lens = np.tile(self._lens, (len(lamps), 1))
        surfaces = None
        if self._by.metal:
            factors = np.stack([self._views[b].metal for b in own] * eyes)  # [E b, 2]: of all but the roughness, and of that
            surfaces = self._surfaces * factors[:, None, [0, 0, 0, 1, 0]]
            surfaces[..., 3] = surfaces[..., 3].clip(*_ROUGHNESS)
        labels = torch.empty_like(pictures[2], dtype=torch.uint8)
        for number in np.unique(which):
            drawing, at = self._drawings[number], np.flatnonzero(which == number)
            links = held.posed(number, own[at])
            if self._thing:
                links.append({self._thing[0][0][0].link: self._task.thing_poses()[own[at]]})
            poses = np.stack([links[a][link] for a, link in drawing.links], 1)
            rows = np.concatenate([at + eye * len(own) for eye in range(eyes)])
            local = viewmats[rows, None] @ np.concatenate([poses] * eyes)
            if len(at) == len(own):
                return self._tables[number][drawing.draw_links(local, lens, *pictures, lamps, surfaces).int()]
            chosen = torch.from_numpy(rows).to(self._device)
            parts = [picture[chosen] for picture in pictures]
            own_surfaces = None if surfaces is None else surfaces[rows]
            labels[chosen] = self._tables[number][drawing.draw_links(local, lens[rows], *parts, lamps[rows], own_surfaces).int()]
            for whole, part in zip(pictures, parts):
                whole[chosen] = part
        return labels

    def _view(self, variation: Variation | None) -> _View:
        """How an episode is seen; without a variation as the scene is."""
        camera, view = self.camera, _View((self.camera,))
        lamp = self._lamp
        if variation is not None:
            by, varied = self._by, variation.camera
            pose = camera.pose.copy()
            pose[:3, 3] += varied[:3, 3]
            pose[:3, :3] = pose[:3, :3] @ varied[:3, :3]
            if by.light:
                brightness, falloff = variation.light
                centred = (camera.rays()[..., :2] / np.abs(camera.rays()[..., :2]).max((0, 1))) ** 2
                view.light = (brightness * (1 - falloff * centred.sum(-1, keepdims=True) / 2)).astype(np.float32)
            camera = replace(camera, pose=pose) if by.camera_position or by.camera_angle else camera
            view.contrast, lamp = variation.texture, lamp + np.append(variation.lamp, 0.0)
            view.metal = variation.metal
        view.cameras = (camera,) if self._sight.eyes == 1 else (camera, camera.beside(self._sight.baseline))
        lamp = camera.pose @ lamp
        view.lamps = np.stack([(each.viewmat @ lamp)[:3] for each in view.cameras])
        return view


def _labels(drawing: InstrumentDrawing) -> np.ndarray:
    """The labels [256] that are shown for those of a drawing: as on rendered/segmentation/image, whatever parts the tool has."""
    table = np.arange(256, dtype=np.uint8)
    for label, (arm, link) in enumerate(drawing.links, FIRST_LINK):
        table[label] = FIRST_LINK + len(LINKS) * arm + (LINKS.index(link) if link in LINKS else 0)
    return table
