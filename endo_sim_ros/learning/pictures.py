"""What the endoscope shows of B episodes: the tissue as it is now and the tool in it, for both eyes and as labels."""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera, invert_pose, sent_poses
from endo_sim_ros.core.device import download, single_threaded_torch, upload
from endo_sim_ros.core.dye import DyedSpot, dyed_model
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import SURFACE
from endo_sim_ros.core.shading import shade, to_bytes
from endo_sim_ros.core.surroundings import fill_holes
from endo_sim_ros.instruments import LINKS, Material, part_links
from endo_sim_ros.instruments.config import DrawingConfig
from endo_sim_ros.instruments.drawing import FIRST_LINK, SURFACES, InstrumentDrawing, lenses
from endo_sim_ros.learning.config import Randomisation, SightConfig
from endo_sim_ros.learning.held_tools import HeldTools
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.tasks import Task
from endo_sim_ros.learning.variation import Variation, departed
from endo_sim_ros.physics import Skinning, TissueBatch
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig, bared_colors, turned_colors
from endo_sim_ros.rendering.config import BehindConfig
from endo_sim_ros.splatting import rasterize

IMAGE, IMAGE_RIGHT, SEGMENTATION = "image", "image_right", "segmentation"
"""Names of the pictures."""

_ROUGHNESS = 0.1, 1.0  # smoother metal would be a mirror, which the drawing has none of
_RENDERING = RenderingConfig()  # pictures are those of rendering_node with its defaults
_Tints = tuple[Tensor, Tensor | None]
"""Coefficients of the colours of all episodes [N, K, 3] or of each [b, N, K, 3], and what is added as Gaussians are bared [N, 3] or
[b, N, 3]."""
_AT_ONCE = 64  # images rasterised together, and on a CPU drawn into


class Pictures:
    """Draws B episodes.

    Args:
        scene: What is seen.
        tissue: How it moves.
        task: What is done there in B episodes.
        sight: What is shown.
        randomisation: How episodes differ.
        held: The tools, or None where pictures show the tissue alone.

    Attributes:
        moved: How the endoscope of each episode departs from where it is [B, 4, 4], see `departed`.
    """

    def __init__(
        self, scene: Scene, tissue: TissueBatch, task: Task, sight: SightConfig, randomisation: Randomisation, held: HeldTools | None
    ):
        self._sight, self._by, self._held, self._task, self._count = sight, randomisation, held, task, (count := task.count)
        nodes = tissue.nodes
        self._set_width(scene.camera, sight.image_width)
        self._device = device = tissue.solver.device
        moves = task.roams or randomisation.camera_position or randomisation.camera_angle
        motion = tissue.solver.motion.config
        model = scene.whole if moves else scene.seen_within(sight.baseline * (sight.eyes - 1), motion.breathing + motion.heartbeat)
        self._model = model.detach().to(device)
        self._tissue = tissue
        own = lambda tensor: tensor.expand(count, *tensor.shape).clone() if sight.dye and tensor is not None else None
        self._sh, self._bared = own(self._model.sh), own(self._model.bared)  # of each episode
        self._skinning = Skinning(self._model, nodes.rest, device=device)
        self._means, self._covars = tissue.append_skinning(self._skinning)
        self._cut: dict[int, DeformableRenderer] = {}  # of episodes whose tissue has been cut
        self._spots: list[Sequence[DyedSpot]] = [()] * count
        self._thing = [thing] if (thing := task.thing()) else []
        shapes = [[*(tool.shape for tool in tools), *self._thing] for tools in held.kinds] if held else []
        self._drawings = [
            InstrumentDrawing([parts for parts, _ in own], device=device, capsules=[capsules for _, capsules in own]) for own in shapes
        ]
        named = part_links(part for parts, _ in self._thing for part in parts)
        self._tables = [torch.from_numpy(_labels(drawing, named)).to(device) for drawing in self._drawings]
        self._at_once = _AT_ONCE if torch.device(device).type == "cpu" else max(count, 1)
        options = DrawingConfig()
        self._lamp = np.array([options.lamp_x, options.lamp_y, 0.0, 1.0])  # m, camera
        self._surfaces = np.array([SURFACES[material] for material in Material])  # [M, 5]
        # What each picture needs in arrays, as it changes with episodes, not with steps.
        self._light = np.tile([1.0, 0.0], (count, 1))  # brightness, and by how much less corners have
        self._contrast = np.ones(count)  # factors on the colours' coefficients
        self._metal = np.ones((count, 2))  # factors on what surfaces give back and on their roughness
        self.moved = np.tile(np.eye(4), (count, 1, 1))
        self._shining = np.tile(self._lamp, (count, 1))  # where the lamp is in the camera of the left eye, m, and 1
        self._poses, self._viewmats = np.zeros((2, sight.eyes, count, 4, 4))  # of the eyes, camera to world, m, and back
        self._lamps = np.zeros((sight.eyes, count, 3))  # m, in the camera of each eye
        self._look(np.arange(count), self.camera.pose)

    def _set_width(self, camera: Camera, width: int) -> None:
        """Draw what a camera sees, with pictures of a width."""
        self.camera = camera.resized(width, max(round(camera.height * width / camera.width), 1))
        self._lens = lenses([self.camera])
        slopes = self.camera.rays()[..., :2]
        self._outward = ((slopes / np.abs(slopes).max((0, 1))) ** 2).sum(-1, keepdims=True)  # [H, W, 1]: 2 at the corners, about

    def at_width(self, width: int) -> "Pictures":
        """Pictures of another width of the same episodes, which go on as these do."""
        other = copy.copy(self)  # shares the arrays
        other._drawings = list(map(copy.copy, self._drawings))  # each keeps what it draws with, which is of one size
        other._set_width(self.camera, width)
        return other

    @property
    def poses(self) -> np.ndarray:
        """Where the left eye of each episode is [B, 4, 4], camera to world, m."""
        return self._poses[0]

    def look_from(self, poses: np.ndarray) -> None:
        """Let the endoscopes be at poses [B, 4, 4], camera to world, m; each departs from it as its episode has it."""
        self._look(np.arange(self._count), sent_poses(poses))

    def _look(self, episodes: np.ndarray, poses: np.ndarray) -> None:
        """Let the endoscopes of these episodes [n] be at poses [4, 4] or [n, 4, 4], from which each departs."""
        left = departed(poses, self.moved[episodes])
        shining = left @ self._shining[episodes, :, None]
        for eye in range(self._sight.eyes):
            pose = left.copy()
            pose[:, :3, 3] += eye * self._sight.baseline * left[:, :3, 0]
            viewmats = invert_pose(pose)
            self._poses[eye, episodes], self._viewmats[eye, episodes] = pose, viewmats
            self._lamps[eye, episodes] = (viewmats @ shining)[:, :3, 0]

    def reset(self, episodes: Tensor, variations: Sequence[Variation], spots: Sequence[Sequence[DyedSpot]]) -> None:
        """Show these episodes [n] at rest, each with its variation and its dyed spots."""
        for b, variation, marked in zip(episodes.tolist(), variations, spots):
            self._light[b], self._contrast[b], self._metal[b] = variation.light, variation.texture, variation.metal
            self.moved[b], self._shining[b] = variation.camera, self._lamp + np.append(variation.lamp, 0.0)
            if self._sh is not None:
                skin = dyed_model(self._model, marked)
                self._sh[b] = skin.sh
                if self._bared is not None and skin.bared is not None:
                    self._bared[b] = skin.bared
                self._spots[b] = marked
                if b in self._cut:
                    self._cut[b].dye(marked)
        self._look(episodes.cpu().numpy(), self.camera.pose)
        self._means[episodes], self._covars[episodes] = self._skinning.means, self._skinning.covars
        if self._tissue.solver.motion.moving:
            positions, F = self._tissue.positions(), self._tissue.gradients()
            for b in episodes.tolist():
                self._means[b], self._covars[b] = self._skinning.deform(positions[b], F[b])

    @torch.no_grad()
    @single_threaded_torch()
    def draw(self, right: bool = False, labels: bool = False) -> dict[str, np.ndarray]:
        """What the endoscope sees of all episodes: ``image`` and ``image_right`` [B, H, W, 3], ``segmentation`` [B, H, W, 1], uint8.

        Args:
            right: Whether the right eye's are wanted.
            labels: Whether labels are: 0 background, 1 tissue, and then the links of the instruments in the order of `LINKS`, those of
                PSM2 after those of PSM1, and the links of the thing of the task.
        """
        parts = [
            self._render(np.arange(i, min(i + self._at_once, self._count)), right, labels) for i in range(0, self._count, self._at_once)
        ]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _render(self, own: np.ndarray, right: bool, labels: bool) -> dict[str, np.ndarray]:
        eyes = range(1 + right)
        seen = [self._rasterize(own[i : i + _AT_ONCE], eye) for eye in eyes for i in range(0, len(own), _AT_ONCE)]
        colors, depths, alphas = seen[0] if len(seen) == 1 else map(torch.cat, zip(*seen))
        if self._held is not None:
            marks = self._draw_tools(self._held, own, len(eyes), (colors, depths, alphas), labels)
        else:
            marks = (alphas > SURFACE).to(torch.uint8)
        factors = None
        if self._by.light:
            brightness, darker = self._light[own].T[..., None, None, None]
            factors = (brightness * (1 - darker * self._outward / 2)).astype(np.float32)
            factors = upload(self._device, np.concatenate([factors] * len(eyes)))[0]
        if self._model.light is not None:
            seeing = [[self.camera.at(pose) for pose in self._poses[eye, own]] for eye in eyes]
            cameras, lamps = sum(seeing, []), seeing[0] * len(eyes)  # the lamp is at the left eye
            each = zip(colors, depths, alphas, cameras, lamps, [None] * len(lamps) if factors is None else factors)
            colors = torch.stack([shade(self._model.light, *picture) for picture in each])
            if self._model.light.filled:
                fill_holes(colors, alphas)
        elif factors is not None:
            colors = colors * factors
        images, *rest = download(to_bytes(colors), *([marks[: len(own), ..., None]] if labels else []))
        found: dict[str, np.ndarray] = dict(zip((IMAGE, IMAGE_RIGHT), np.split(images, len(eyes))))
        if labels:
            (found[SEGMENTATION],) = rest
        return found

    def _rasterize(self, own: np.ndarray, eye: int) -> tuple[Tensor, Tensor, Tensor]:
        rows = slice(own[0], own[-1] + 1)
        sh = self._model.sh if self._sh is None else self._sh[rows]
        bared = self._model.bared if self._bared is None else self._bared[rows]
        seen = self._draw_tissue(rows, eye, self._model, self._skinning, (sh, bared), self._means[rows], self._covars[rows])
        for i, b in enumerate(own):
            if len(cuts := self._tissue.cuts(b)):
                renderer = self._parted(b, cuts)
                skinning, (means, covars) = renderer.skinning, renderer.deform(*self._tissue.state(b))
                assert skinning is not None  # as it was made with nodes
                model = renderer.opened(means, skinning.means)
                parted = self._draw_tissue(slice(b, b + 1), eye, model, skinning, (model.sh, model.bared), means[None], covars[None])
                for whole, part in zip(seen, parted):
                    whole[i] = part[0]
        return seen

    def _parted(self, b: int, cuts: np.ndarray) -> DeformableRenderer:
        """What shows the skin of an episode parted along cuts [T, 3, 3], m, world, at rest, and flesh between: that of rendering_node."""
        if b not in self._cut:
            config = RenderingConfig(device=self._device, behind=BehindConfig(shown=False))
            self._cut[b] = DeformableRenderer(self._model, self._tissue.nodes.rest, config)
            self._cut[b].dye(self._spots[b])
        self._cut[b].cut(cuts.astype(np.float32))
        return self._cut[b]

    def _draw_tissue(
        self, rows: slice, eye: int, model: GaussianModel, skinning: Skinning, tints: _Tints, means: Tensor, covars: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colours, depths and alphas [b, H, W, …] of the tissue in these episodes, whose Gaussians are at means [b, N, 3] with
        covariances [b, N, 3, 3]."""
        viewmats = self._viewmats[eye, rows]
        transforms, Ks = upload(self._device, viewmats, np.array([self.camera.K] * len(viewmats)))
        colors, films = self._colors(rows, eye, model, skinning, tints, means)
        glints = None if model.light is None else model.light.glint_sharpness
        options: dict[str, Any] = {"covars": covars, "extras": films, "glints": glints}
        size = self.camera.width, self.camera.height
        return rasterize(means, None, None, model.opacities, colors, transforms, Ks, *size, **options)[:3]

    def _colors(
        self, rows: slice, eye: int, model: GaussianModel, skinning: Skinning, tints: _Tints, means: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Colours [N, K, 3] of all these episodes, or [b, N, K, 3] of each, and films where tissue reflects, as `rasterize` takes them."""
        poses, (sh, bared), films = self._poses[eye, rows], tints, None
        if model.reflects or model.sh_degree or bared is not None:
            F = self._tissue.gradients(rows)  # as on control_nodes
        if bared is not None:
            sh = bared_colors(sh, bared, skinning.strains(F), _RENDERING.bared_strain)
        if self._by.texture:
            sh = sh * sh.new_tensor(self._contrast[rows])[:, None, None, None]
        if model.reflects:
            sh, films = skinning.seen(F, means, list(poses[:, :3, 3]), sh)
        elif model.sh_degree:
            own, (eyes,) = sh.expand(len(poses), *sh.shape[-3:]), upload(self._device, poses[:, :3, 3])
            sh = torch.stack([turned_colors(own, skinning, *each) for own, *each in zip(own, means, F, eyes)])
        return sh, films

    def _draw_tools(self, held: HeldTools, own: np.ndarray, eyes: int, pictures: tuple[Tensor, Tensor, Tensor], labelled: bool) -> Tensor:
        """Draw the tools into the colours, depths and alphas of these episodes, eye after eye.

        Returns:
            Their labels [E b, H, W], uint8; without `labelled` those of the drawing, which cost nothing.
        """
        which = held.kind(own)
        viewmats, lamps = (each[:eyes, own].reshape(-1, *each.shape[2:]) for each in (self._viewmats, self._lamps))
        lens = np.tile(self._lens, (len(lamps), 1))
        surfaces = None
        if self._by.metal:
            factors = np.tile(self._metal[own], (eyes, 1))  # [E b, 2]: of all but the roughness, and of that
            surfaces = self._surfaces * factors[:, None, [0, 0, 0, 1, 0]]
            surfaces[..., 3] = surfaces[..., 3].clip(*_ROUGHNESS)
        labels = torch.empty_like(pictures[2], dtype=torch.uint8)
        for number in np.unique(which):
            drawing, at = self._drawings[number], np.flatnonzero(which == number)
            links = held.posed(number, own[at])
            if self._thing:
                links.append({link: poses[own[at]] for link, poses in self._task.thing_poses().items()})
            poses = np.stack([links[a][link] for a, link in drawing.links], 1)
            rows = np.concatenate([at + eye * len(own) for eye in range(eyes)])
            local = viewmats[rows, None] @ np.concatenate([poses] * eyes)
            if len(at) == len(own):
                marks = drawing.draw_links(local, lens, *pictures, lamps, surfaces, self._model.light)
                return self._tables[number][marks.int()] if labelled else marks
            chosen = torch.from_numpy(rows).to(self._device)
            parts = [picture[chosen] for picture in pictures]
            own_surfaces = None if surfaces is None else surfaces[rows]
            marks = drawing.draw_links(local, lens[rows], *parts, lamps[rows], own_surfaces, self._model.light)
            labels[chosen] = self._tables[number][marks.int()] if labelled else marks
            for whole, part in zip(pictures, parts):
                whole[chosen] = part
        return labels


def _labels(drawing: InstrumentDrawing, things: tuple[str, ...]) -> np.ndarray:
    """The labels [256] that are shown for those of a drawing: as on rendered/segmentation/image, whatever parts the tool has.

    Args:
        drawing: What draws the tools, and the thing after these.
        things: Names of the links of the thing.
    """
    table = np.arange(256, dtype=np.uint8)
    for label, (arm, link) in enumerate(drawing.links, FIRST_LINK):
        table[label] = FIRST_LINK + len(LINKS) * arm + next((own.index(link) for own in (LINKS, things) if link in own), 0)
    return table
