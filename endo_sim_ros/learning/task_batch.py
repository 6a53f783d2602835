"""B episodes of a task in the simulation: one batched solver, one renderer, no framework; what environments and training share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.shading import shade, to_bytes
from endo_sim_ros.learning.config import Randomisation
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.tasks import Outcome, find_task
from endo_sim_ros.physics import Skinning, TissueBatch
from endo_sim_ros.rendering import turned_colors
from endo_sim_ros.splatting import rasterize

RESTING_SPEED = 1e-5  # m/s; as in TissueSimulation: one tissue slower than this, that no tool moves, is left as it is
_AT_ONCE = 64  # images drawn together
_BELOW = 1e-9  # share taken off random stiffness: rounded, it must not exceed what the substeps were planned for

Observations = Literal["state", "image", "both"]


@dataclass
class _View:
    """How one episode is seen."""

    camera: Camera
    light: np.ndarray | None = None  # [H, W, 1] factor, None = 1
    contrast: float = 1.0  # factor on the colours' coefficients


class TaskBatch:
    """B episodes of one task.

    On a CPU the same seeds and actions give the same observations, images too, bit by bit, whatever the number of threads and B.

    Args:
        task: Its name.
        scene: What is touched.
        count: B.
        observations: ``state``: float32 [B, n]; ``image``: uint8 [B, H, W, 3]; ``both``: a dict of the two by these names.
        randomisation: How episodes differ.
        image_width: Pixels; the height follows from the scene's camera.
        device: Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N.
        images: Make `images` possible also where images are not observed.

    Raises:
        ValueError: If there is no such task, or the scene is too small for it.
    """

    def __init__(
        self,
        task: str,
        scene: Scene,
        count: int = 1,
        observations: Observations = "state",
        randomisation: Randomisation = Randomisation(),
        image_width: int = 64,
        device: str = "auto",
        images: bool = False,
    ):
        kind = find_task(task)
        config = kind.physics(device)
        nodes = scene.nodes(config)
        self.task, self.count = kind(nodes, scene.camera.position, count), count
        self.observations, self.randomisation = observations, randomisation
        largest = kind.largest_stiffness * float(np.exp(randomisation.stiffness))
        self.tissue = TissueBatch(nodes, config, count, 1, stiffness=np.full(count, largest) if largest != 1 else None)
        self._varies = largest != 1
        self._rest = torch.from_numpy(nodes.rest)
        self._resting, self._placed = True, False  # of a single tissue
        camera = scene.camera
        self.camera = camera.resized(image_width, max(round(camera.height * image_width / camera.width), 1))
        self.views: list[_View] = []
        if images or observations != "state":
            device = self.tissue.solver.device
            model = scene.model.detach().to(device)
            self._skinning = Skinning(model, nodes.rest, device=device)
            self._means, self._covars = self.tissue.append_skinning(self._skinning)
            self._model = model
            self._pinned = torch.from_numpy(nodes.pinned).to(device)[:, None, None]
            self.views = [_View(self.camera) for _ in range(count)]

    def reset(self, episodes: Sequence[int], generators: Sequence[np.random.Generator]) -> None:
        """Begin these episodes anew, each by the chance of its generator."""
        for b, rng in zip(episodes, generators):
            self.task.reset(b, rng)
            chance = rng.uniform(-1, 1, 10)  # always as many, so that what is randomised does not change the task
            if self._varies:
                factor = np.exp(self.randomisation.stiffness * chance[0]) * (1 - _BELOW * (self.randomisation.stiffness > 0))
                self.tissue.solver.set_stiffness(slice(b, b + 1), factor * self.task.stiffness(b)[None])
            if self.views:
                self.views[b] = self._view(chance)
        chosen = torch.as_tensor(list(episodes), dtype=torch.long, device=self.tissue.solver.device)
        self.tissue.reset(chosen)
        self._resting, self._placed = True, False
        if self.views:
            self._means[chosen], self._covars[chosen] = self._skinning.means, self._skinning.covars

    def step(
        self, actions: np.ndarray, renew: Sequence[int] = (), generators: Sequence[np.random.Generator] = ()
    ) -> tuple[np.ndarray | dict[str, np.ndarray], Outcome]:
        """Take one step with actions [B, 4]. The episodes in ``renew`` take none: each begins anew, by the chance of its generator.

        Returns:
            What `observe` gives at the end of the step, and its outcome.
        """
        self._advance(actions, renew, generators)
        observations = self.observe()
        return observations, self.task.judge()

    def _advance(self, actions: np.ndarray, renew: Sequence[int], generators: Sequence[np.random.Generator]) -> None:
        tips, closed = self.task.act(actions)
        if len(renew):
            self.reset(renew, generators)
        tools = self.tissue.tools
        tips = torch.from_numpy(tips)[:, None].to(tools.tips.device)
        moved = not self._placed or not torch.equal(tips, tools.tips)
        present = torch.ones((self.count, 1), dtype=torch.int32)
        present[list(renew)] = 0
        tools.tips.copy_(tips)
        tools.rotations.copy_(torch.eye(3, dtype=torch.float64).expand_as(tools.rotations))
        tools.present.copy_(present)
        tools.closed.copy_(torch.from_numpy(closed.astype(np.int32))[:, None] * present)
        self._placed = True
        if self.count == 1 and self._rests(moved):
            return
        self.tissue.step()
        self._resting = self.count == 1 and self.tissue.solver.speed < RESTING_SPEED

    def _rests(self, moved: bool) -> bool:
        """Whether a single tissue is left as it is, as TissueSimulation does, so that the graph gives the same bits."""
        tools = self.tissue.tools
        before = bool(tools.gripping[0, 0])
        tools.take_hold()
        holding = bool(tools.gripping[0, 0])
        return self._resting and holding == before and not (moved and (holding or tools.contact_radius > 0))

    def observe(self) -> np.ndarray | dict[str, np.ndarray]:
        """Observations of all episodes now."""
        state = self.state()
        if self.observations == "state":
            return state
        images = self.images()
        return images if self.observations == "image" else {"state": state, "image": images}

    def state(self) -> np.ndarray:
        """What a policy sees of each environment, numbers alone [B, D]."""
        sites, device = torch.from_numpy(self.task.sites), self.tissue.solver.device
        rows = torch.arange(self.count)[:, None]
        moved = self.tissue.displacements[rows.to(device), sites.to(device)].cpu()
        positions = (self._rest[sites] + moved).numpy()
        return self.task.observe(positions, self.tissue.tools.reaction_forces[:, 0].cpu().numpy())

    @torch.no_grad()
    def images(self) -> np.ndarray:
        """What the endoscope sees of all episodes [B, H, W, 3], uint8."""
        return np.concatenate([self._render(slice(i, i + _AT_ONCE)) for i in range(0, self.count, _AT_ONCE)])

    def _render(self, own: slice) -> np.ndarray:
        views, at_rest = self.views[own], self._model
        tensor = lambda arrays: torch.from_numpy(np.stack(arrays).astype(np.float32)).to(at_rest.means.device)
        seen = rasterize(
            self._means[own], None, None, at_rest.opacities, self._colors(own),
            tensor([view.camera.viewmat for view in views]), tensor([view.camera.K for view in views]),
            self.camera.width, self.camera.height, covars=self._covars[own],
        )  # fmt: skip
        colors = seen.colors
        if at_rest.light is not None:
            pictures = zip(colors, seen.depths, seen.alphas, (view.camera for view in views))
            colors = torch.stack([shade(at_rest.light, *picture) for picture in pictures])
        if any(view.light is not None for view in views):
            one = np.ones((1, 1, 1), np.float32)
            factors = [np.broadcast_to(one if view.light is None else view.light, (*colors.shape[1:3], 1)) for view in views]
            colors = colors * tensor(factors)
        return to_bytes(colors).cpu().numpy()

    def _colors(self, own: slice) -> torch.Tensor:
        """Colours of all these episodes [N, K, 3], or of each [b, N, K, 3], as `rasterize` takes them."""
        views, sh = self.views[own], self._model.sh
        if self._model.sh_degree:
            F = torch.where(self._pinned, torch.eye(3, device=sh.device), self.tissue.F[own])  # as on control_nodes
            seen = zip(self._means[own], F, (view.camera for view in views))
            sh = torch.stack([turned_colors(sh, self._skinning, *each) for each in seen])
        if self.randomisation.texture:
            sh = sh * sh.new_tensor([view.contrast for view in views])[:, None, None, None]
        return sh

    def _view(self, chance: np.ndarray) -> _View:
        """How an episode is seen, by numbers [10] in -1 … 1."""
        by, camera = self.randomisation, self.camera
        pose = camera.pose.copy()
        pose[:3, 3] += by.camera_position * chance[1:4]
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(by.camera_angle) * chance[4:7]).as_matrix()
        light = None
        if by.light:
            centred = (camera.rays()[..., :2] / np.abs(camera.rays()[..., :2]).max((0, 1))) ** 2
            falloff = by.light * 0.5 * (1 + chance[8])
            light = ((1 + by.light * chance[7]) * (1 - falloff * centred.sum(-1, keepdims=True) / 2)).astype(np.float32)
        camera = replace(camera, pose=pose) if by.camera_position or by.camera_angle else camera
        return _View(camera, light, 1 + by.texture * float(chance[9]))
