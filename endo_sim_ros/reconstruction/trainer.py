"""Optimises Gaussians against a few views (paper eq. 7) and virtual cameras between them (eq. 8, 9)."""

import dataclasses
import logging
import math
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.cameras import Camera, interpolate_pose
from endo_sim_ros.device import pick_device
from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.reconstruction import densification, losses
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.depth import with_depth_prior
from endo_sim_ros.reconstruction.initialization import initial_model
from endo_sim_ros.reconstruction.presets import resolved
from endo_sim_ros.reconstruction.triangulation import triangulate
from endo_sim_ros.sequences.frames import Frame, SequenceError
from endo_sim_ros.splatting import RenderOutput, rasterize

log = logging.getLogger(__name__)

# Learning rates of 3DGS, those of sizes and colours raised for a tenth of its iterations. That of the means is in units
# of the scene's depth and decays to a hundredth.
_RATES = {
    "means": 1.6e-4, "quats": 1e-3, "log_scales": 2e-2, "logit_opacities": 5e-2, "sh_base": 1e-2, "sh_rest": 1.25e-4,
}  # fmt: skip
_NOISE = 5e5  # of 3DGS-MCMC, in units of the means' learning rate, for a scene of depth 1
_LARGEST = 0.06  # standard deviation of a Gaussian, in units of the scene's depth
_LAST_REFINEMENT = 0.8  # share of the iterations after which the number of Gaussians stays fixed


@dataclass(frozen=True)
class _View:
    """A training view on the compute device."""

    camera: Camera
    viewmat: Tensor  # [1, 4, 4]
    K: Tensor  # [1, 3, 3]
    image: Tensor  # [H, W, 3] in [0, 1]
    depth: Tensor | None  # [H, W] m, 0 = none
    mask: Tensor | None  # [H, W] 1 = tissue


class Progress(NamedTuple):
    """What a running reconstruction reports."""

    iteration: int
    iterations: int
    loss: float
    gaussians: int


class Trainer:
    """Trains a Gaussian model on posed views.

    Args:
        frames: Training views; every one is used (see `select_keyframes`).
        config: Options.

    Raises:
        SequenceError: If there are no views, all pixels are masked, or the views give no scene points to start from.
    """

    def __init__(self, frames: list[Frame], config: ReconstructionConfig):
        if not frames:
            raise SequenceError("there are no views to reconstruct from; check the image, camera_info and pose topics")
        if all(frame.mask is not None and not frame.mask.any() for frame in frames):
            raise SequenceError("every pixel of every view is masked; a mask has 255 where there is tissue")
        self.config = config = resolved(config)
        self.device = pick_device(config.device)
        points, colors, _ = triangulate(frames)
        frames = [shrink(frame, config.image_width) for frame in with_depth_prior(frames, points, config)]
        model = initial_model(frames, points, colors, config)
        self._views = [self._to_device(frame) for frame in frames]
        eye = np.mean([view.camera.position for view in self._views], 0)
        self._eye = torch.as_tensor(eye, dtype=torch.float32, device=self.device)
        self._nearest = _nearest_views(frames)
        self.scene_depth = _median_depth(frames, model)
        self._stamps = [frame.stamp_ns for frame in frames]
        self.iteration = 0
        self._generator = torch.Generator().manual_seed(config.seed)
        self._order: list[int] = []
        self._last_loss = torch.zeros(())
        self._set_model(model.to(self.device))

    # ------------------------------------------------------------------ state

    @property
    def model(self) -> GaussianModel:
        """The current model, detached."""
        return GaussianModel(**{name: tensor.detach().clone() for name, tensor in self._current().tensors().items()})

    @property
    def cameras(self) -> list[Camera]:
        """The training cameras at training size."""
        return [view.camera for view in self._views]

    @property
    def progress(self) -> Progress:
        return Progress(self.iteration, self.config.iterations, float(self._last_loss), len(self._parameters["means"]))

    def save_checkpoint(self, path: str | Path) -> None:
        """Write model, optimiser and random state; a training that loads them goes on as if never interrupted."""
        path = Path(path)
        state = {
            "config": dataclasses.asdict(self.config),
            "stamps": self._stamps,
            "iteration": self.iteration,
            "model": self.model.tensors(),
            "optimizer": self._optimizer.state_dict(),
            "generator": self._generator.get_state(),
            "order": self._order,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".part")
        torch.save(state, partial)
        partial.replace(path)

    def load_checkpoint(self, path: str | Path) -> None:
        """Continue from a checkpoint of the same views and options.

        Raises:
            SequenceError: If the file is not a checkpoint, or one of other views or options.
        """
        try:
            state = _read_checkpoint(Path(path), self.device)
            mine = dataclasses.asdict(self.config)
            differing = [name for name in mine if name != "device" and mine[name] != state["config"].get(name)]
            if differing or state["stamps"] != self._stamps:
                what = f"other options ({', '.join(differing)})" if differing else "other views"
                raise SequenceError(f"{path}: the checkpoint was made with {what}; use the same or start anew")
            iteration, order = int(state["iteration"]), [int(view) for view in state["order"]]
            if iteration < 0 or not set(order) <= set(range(len(self._views))):
                raise ValueError("it names views or an iteration that there cannot be")
            generator = torch.Generator()
            generator.set_state(state["generator"].cpu())
            self._set_model(GaussianModel(**state["model"]))  # what is refused was so before: a training goes on as it was
            self._optimizer.load_state_dict(self._optimizer.state_dict() | {"state": state["optimizer"]["state"]})
            self._generator = generator
            self.iteration, self._order = iteration, order
        except SequenceError:
            raise
        except Exception as error:  # a damaged file can make the unpickler raise anything
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise SequenceError(f"{path}: not a readable checkpoint ({reason})") from error

    # --------------------------------------------------------------- training

    def run(self, on_progress: Callable[[Progress], bool | None] | None = None, every: int = 20) -> GaussianModel:
        """Train to the end; ``on_progress`` is called every few iterations and may return False to stop early."""
        while self.iteration < self.config.iterations:
            self.step()
            due = self.iteration % every == 0 or self.iteration == self.config.iterations
            if on_progress and due and on_progress(self.progress) is False:
                break
        return self.model

    def step(self) -> None:
        """One iteration: a training view, a virtual view, one step of the optimiser."""
        config = self.config
        if not self._order:
            self._order = torch.randperm(len(self._views), generator=self._generator).tolist()
        index = self._order.pop()
        loss = self._view_loss(self._views[index])
        if config.virtual_every and self.iteration % config.virtual_every == 0 and len(self._views) > 1:
            loss = loss + self._virtual_loss(index)
        if config.lambda_flat:
            loss = loss + config.lambda_flat * losses.depth_extent(self._current(), self._eye).mean()
        loss.backward()
        self._last_loss = loss.detach()
        decay = 0.01 ** (self.iteration / config.iterations)
        self._optimizer.param_groups[0]["lr"] = _RATES["means"] * self.scene_depth * config.learning_rate * decay
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)
        self.iteration += 1
        with torch.no_grad():
            # Nothing holds the size of Gaussians where every view is masked; one that grew would smear the deformed scene.
            self._parameters["log_scales"].clamp_(max=math.log(_LARGEST * self.scene_depth))
            refining = self.iteration <= _LAST_REFINEMENT * config.iterations
            if refining and self.iteration % config.refine_every == 0:
                self._refine()
            self._explore()

    def _render(self, viewmat: Tensor, K: Tensor, camera: Camera, masks: Tensor | None = None) -> RenderOutput:
        model = self._current()
        return rasterize(
            model.means, model.quats, model.scales, model.opacities, model.sh,
            viewmat, K, camera.width, camera.height, masks=masks,
        )  # fmt: skip

    def _view_loss(self, view: _View) -> Tensor:
        """Paper eq. 7: photometric, depth, distortion and total variation of one training view."""
        config = self.config
        masks = None if view.mask is None else view.mask[None] > 0
        output = self._render(view.viewmat, view.K, view.camera, masks)
        loss = losses.photometric(output.colors[0], view.image, view.mask, config.lambda_ssim)
        if view.depth is not None and config.lambda_depth:
            error = losses.depth_l1(output.depths[0], view.depth, view.mask)
            loss = loss + config.lambda_depth / self.scene_depth * error
        return loss + self._regularization(output, view.mask)

    def _virtual_loss(self, index: int) -> Tensor:
        """Paper eq. 9: distortion and total variation from a virtual camera between a view and its nearest view."""
        first, second = self._views[index], self._views[self._nearest[index]]
        alpha = torch.rand((), generator=self._generator).item()
        camera = first.camera.at(interpolate_pose(first.camera.pose, second.camera.pose, alpha))
        viewmat = torch.as_tensor(camera.viewmat, dtype=torch.float32, device=self.device)[None]
        return self._regularization(self._render(viewmat, first.K, camera), None)

    def _regularization(self, output: RenderOutput, mask: Tensor | None) -> Tensor:
        config = self.config
        distortion = losses.masked_mean(output.distortions[0], mask)
        variation = losses.total_variation(output.depths[0], mask)
        return (config.lambda_dist * distortion + config.lambda_tv * variation) / self.scene_depth

    # --------------------------------------------------------------- Gaussians

    def _set_model(self, model: GaussianModel) -> None:
        """Start optimising a model with a fresh optimiser."""
        self._parameters = {name: tensor.clone().requires_grad_() for name, tensor in _parameters(model).items()}
        factor = self.config.learning_rate
        groups = [{"params": [tensor], "lr": factor * _RATES[name]} for name, tensor in self._parameters.items()]
        self._optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)

    def _current(self) -> GaussianModel:
        """The model made of the parameters, through which gradients flow."""
        p = self._parameters
        sh = torch.cat([p["sh_base"], p["sh_rest"]], 1) if "sh_rest" in p else p["sh_base"]
        return GaussianModel(p["means"], p["quats"], p["log_scales"], p["logit_opacities"], sh)

    def _refine(self) -> None:
        """Relocate and add Gaussians, carrying the optimiser's state of those that stay."""
        model, source, fresh = densification.refine(
            self.model, self.config.growth, self.config.max_gaussians, self._generator
        )
        states = [self._optimizer.state[group["params"][0]] for group in self._optimizer.param_groups]
        self._set_model(model)
        for group, state in zip(self._optimizer.param_groups, states):
            moved = {key: value[source] if value.ndim else value for key, value in state.items()}
            for key in ("exp_avg", "exp_avg_sq"):
                if key in moved:
                    moved[key][fresh] = 0
            self._optimizer.state[group["params"][0]] = moved

    def _explore(self) -> None:
        """Move faint Gaussians about at random."""
        model = self._current()
        faint = (model.opacities < 10 * densification.DEAD_OPACITY).nonzero()[:, 0]
        if len(faint):
            model = model.select(faint)
            # Variances are in m²: divided by the squared depth of the scene, steps are those of a scene of depth 1.
            scale = _NOISE * self._optimizer.param_groups[0]["lr"] / self.scene_depth**2
            noise = densification.exploration_noise(model, scale, self._generator)
            self._parameters["means"][faint] += noise

    # --------------------------------------------------------------- inputs

    def _to_device(self, frame: Frame) -> _View:
        tensor = lambda array: torch.tensor(array, dtype=torch.float32, device=self.device)
        camera = frame.camera
        return _View(
            camera,
            tensor(camera.viewmat)[None],
            tensor(camera.K)[None],
            tensor(frame.image) / 255,
            None if frame.depth is None else tensor(frame.depth),
            None if frame.mask is None or frame.mask.all() else tensor(frame.mask > 0),
        )


def _parameters(model: GaussianModel) -> dict[str, Tensor]:
    """The tensors of a model that are optimised, by name."""
    tensors = model.tensors() | {"sh_base": model.sh[:, :1], "sh_rest": model.sh[:, 1:]}
    return {name: tensors[name] for name in _RATES if tensors[name].numel()}


def _read_checkpoint(path: Path, device: torch.device) -> dict:
    """The contents of a checkpoint. No code in it runs, and its tensors are no larger than the file.

    Raises:
        ValueError: If the file claims more than it holds, or the state of the optimiser does not fit the model.
    """
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > size:
            raise ValueError("it claims more than it holds")
        if archive.testzip() is not None:
            raise ValueError("it is damaged")
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except pickle.UnpicklingError:  # whose text advises to load it all the same
        raise ValueError("it holds other objects than tensors and numbers") from None
    moments = state["optimizer"]["state"]  # of each parameter, by its number; empty before the first step
    tensors = [*state["model"].values(), *(value for values in moments.values() for value in values.values())]
    if sum(tensor.numel() * tensor.element_size() for tensor in tensors) > size:  # views of less
        raise ValueError("it claims more than it holds")
    if any(tensor.dtype != torch.float32 or tensor.is_meta or not tensor.isfinite().all() for tensor in tensors):
        raise ValueError("its tensors are not of finite float32 numbers")
    shapes = [tensor.shape for tensor in _parameters(GaussianModel(**state["model"])).values()]  # none without Gaussians
    found = {number: {name: value.shape for name, value in values.items()} for number, values in moments.items()}
    if not shapes or found and found != {n: {"step": (), "exp_avg": shape, "exp_avg_sq": shape} for n, shape in enumerate(shapes)}:
        raise ValueError("the state of the optimiser does not fit the model")
    return state


def _median_depth(frames: list[Frame], model: GaussianModel) -> float:
    """Median depth of the Gaussians in front of the views, metres."""
    points = model.means.numpy().astype(np.float64)
    depths = np.concatenate([frame.camera.project(points)[1] for frame in frames])
    return float(np.median(depths[depths > 0]))


def shrink(frame: Frame, width: int) -> Frame:
    """The frame at the given width (pixels), if it is wider; the intrinsics follow.

    Colours are averaged; depth is that at the pixel's centre; a pixel is tissue if all that it averages is.
    """
    camera = frame.camera
    if camera.width <= width:
        return frame
    size = (width, max(round(camera.height * width / camera.width), 1))
    average = lambda image: cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    scale = np.diag([size[0] / camera.width, size[1] / camera.height, 1])
    return dataclasses.replace(
        frame,
        image=average(frame.image),
        camera=camera.resized(*size),
        right=None if frame.right is None else average(frame.right),
        right_K=None if frame.right_K is None else scale @ frame.right_K,
        # Plain INTER_NEAREST takes the corner instead of the centre.
        depth=None if frame.depth is None else cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST_EXACT),
        mask=None if frame.mask is None else np.uint8(255) * (average(np.float32(frame.mask > 0)) > 0.999),
    )


def _nearest_views(frames: list[Frame]) -> list[int]:
    """Index of each view's nearest other view (by optical centre); its own for a single view."""
    centres = np.array([frame.camera.position for frame in frames])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(distance, math.inf)
    return distance.argmin(1).tolist()
