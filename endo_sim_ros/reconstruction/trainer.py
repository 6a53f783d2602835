"""Optimises Gaussians against a few views (paper eq. 7) and virtual cameras between them (eq. 8, 9)."""

import dataclasses
import functools
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

from endo_sim_ros.core.cameras import Camera, interpolate_pose
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import Light, directions, falloff, features, log_brightness
from endo_sim_ros.reconstruction import losses, photometry
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.dynamic_mask import without_motion
from endo_sim_ros.reconstruction.initialization import initial_model
from endo_sim_ros.reconstruction.optimizer import Adam
from endo_sim_ros.reconstruction.presets import resolved
from endo_sim_ros.reconstruction.priors.extrapolation import with_surroundings
from endo_sim_ros.reconstruction.priors.multi_view import agreed
from endo_sim_ros.reconstruction.priors.sources import depth_source, right_view, with_depth_prior
from endo_sim_ros.reconstruction.strategies import mcmc
from endo_sim_ros.reconstruction.triangulation import ScenePoints, match_features, misposed, triangulate
from endo_sim_ros.splatting import RenderOutput, rasterize
from endo_sim_ros.splatting.graph_capture import Recording

log = logging.getLogger(__name__)

# Learning rates of 3DGS, those of sizes and colours raised for a tenth of its iterations. That of the means is in units
# of the scene's depth and decays to a hundredth.
_RATES = {
    "means": 1.6e-4, "quats": 1e-3, "log_scales": 2e-2, "logit_opacities": 5e-2, "sh_base": 1e-2, "sh_rest": 1.25e-4,
}  # fmt: skip
_NOISE = 5e5  # of 3DGS-MCMC, in units of the means' learning rate, for a scene of depth 1
_LARGEST = 0.06  # standard deviation of a Gaussian, in units of the scene's depth
_LAST_REFINEMENT = 0.8  # share of the iterations after which the number of Gaussians stays fixed
_SEEN = 0.8  # share of the Gaussians that stand for what the training views see, at first
_LIGHT_ANCHOR = 1e-3  # weight of the light's changes in training
_WHITE, _BLACK = 250, 8  # grey levels of all channels, from which on, and up to which, nothing is seen
_MOSTLY = 0.5  # share of the tissue, from which on a white view is overexposed
_ALMOST_ALL = 0.95  # share of a black view; much of a good one may lie in the dark
_NOTHING = {
    "masked": "every pixel of every view is masked; a mask has 255 where there is tissue",
    "overexposed": "every view is overexposed; lower the light or the camera's exposure",
    "black": "every view is black; switch on the light, or check the camera",
}
_MOST_ITERATIONS, _LEAST_TRAINING = 3000, 1 / 3  # and the least share of them
_SHARP = 0.15  # pixels: views that agree so well are worth all iterations
_FINER = 2  # times the width trained on, at which depth is corrected where images are so fine
_NARROWEST = 64  # pixels; images are not halved below when memory runs out
_SELDOM = 4  # iterations between steps that may be taken seldom, and then are as much larger
_EXPOSURE_RATE, _LIGHT_RATE = 1e-3, 2e-3  # learning rates of log exposures and of the light's four numbers


@dataclass(frozen=True)
class _View:
    """A training view on the compute device."""

    camera: Camera
    image: Tensor  # [H, W, 3] in [0, 1]
    depth: Tensor | None  # [H, W] m, 0 = none
    mask: Tensor | None  # [H, W] 1 = tissue
    exposure: int  # whose exposure it has: its own, or that of the left view of its pair
    exposure_index: Tensor  # [1] the same


class _Inputs(NamedTuple):
    """What is new in an iteration, on the compute device; C = 2 with a virtual camera, else 1."""

    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    image: Tensor  # [H, W, 3] of the training view, and so on
    exposure: Tensor  # [1] int64
    mask: Tensor | None  # [H, W]
    depth: Tensor | None  # [H, W]
    rays: Tensor | None  # [3, H, W], for the light
    carried: Tensor | None  # [H, W] depth prior as the virtual camera sees it


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
        points: Scene points: positions [N, 3] (m, world), RGB [N, 3] in [0, 1] and, if known, error (see `ScenePoints`), for
            instance of structure from motion with more views than these; None triangulates these views.

    Raises:
        SequenceError: If there are no views, all pixels are masked or white, the views give no scene points to start from, or
            those given are not finite.
    """

    def __init__(self, frames: list[Frame], config: ReconstructionConfig, points: ScenePoints | tuple | None = None):
        if not frames:
            raise SequenceError("there are no views to reconstruct from; check the image, camera_info and pose topics")
        self.config = config = resolved(config)
        self.device = pick_device(config.device)
        source = depth_source(frames, config)
        frames, points = _consistent(_showing(frames), config, None if points is None else _checked(ScenePoints(*points)))
        correcting = config.multi_view_refinement and source not in ("topic", "none")
        if correcting or not config.iterations:
            # Flow is the more precise the finer the pixels are, as matching is.
            fine = [shrink(frame, _FINER * config.image_width) for frame in frames]
            corrected, contradiction = agreed(fine, points, source)
            if correcting:
                frames = corrected
            if not config.iterations:
                coarser = min(config.image_width / fine[0].camera.width, 1)
                self.config = config = _as_long_as_worth(config, contradiction * coarser)
        frames = [shrink(frame, config.image_width) for frame in frames]
        if config.dynamic_mask:
            frames = without_motion(frames, config.depth_tolerance)
        seen = int(_SEEN * config.max_gaussians) if config.extrapolation else config.max_gaussians
        model = initial_model(frames, points.positions, points.colors, dataclasses.replace(config, max_gaussians=max(seen, 1)))
        self.scene_depth = _median_depth(frames, model)
        light, exposures = np.zeros(4), np.zeros((len(frames), 3))
        if self._lit:
            means = model.means.numpy().astype(np.float64)
            light, exposures = photometry.fit_light(
                frames, means, self.scene_depth, config.depth_tolerance, light=config.light, exposure=config.exposure
            )
            model = photometry.unlit(model, frames, light, exposures, self.scene_depth, config.depth_tolerance)
        if config.extrapolation:
            about = light, exposures, self.scene_depth, points.positions
            model = with_surroundings(model, frames, *about, config.extrapolation, config.max_gaussians)
        self._load(frames)
        eye = np.mean([view.camera.position for view in self._views], 0)
        self._eye = torch.as_tensor(eye, dtype=torch.float32, device=self.device)
        self._nearest = _nearest_views(frames)
        self._stamps = [frame.stamp_ns for frame in frames]
        self.iteration = 0
        self._generator = torch.Generator().manual_seed(config.seed)
        # Drawn where it is needed: a GPU that waits for numbers stands still.
        self._noise = self._generator if self.device == "cpu" else torch.Generator(self.device).manual_seed(config.seed)
        self._order: list[int] = []
        self._recordings: dict[tuple, Recording] = {}
        self._last_loss = torch.zeros(())
        self._light_prior = torch.tensor(light, dtype=torch.float32, device=self.device)
        exposures = torch.tensor(exposures, dtype=torch.float32, device=self.device)
        self._exposure_level = exposures.mean(0)
        self._set_light(self._light_prior, exposures)
        self._set_model(model.to(self.device))

    # ------------------------------------------------------------------ state

    @property
    def model(self) -> GaussianModel:
        """The current model, detached, with its light."""
        return dataclasses.replace(self._detached(), light=self.light)

    def _detached(self) -> GaussianModel:
        return GaussianModel(**{name: tensor.detach().clone() for name, tensor in self._current().tensors().items()})

    @property
    def _lit(self) -> bool:
        return self.config.light or self.config.exposure

    @property
    def light(self) -> Light | None:
        """The light, with the exposure that was learnt from the training views."""
        return self._fitted_light()[0]

    @property
    def drift(self) -> photometry.Drift:
        """How exposure changed in the course of the recording beyond what the light explains."""
        return photometry.Drift(self._stamps, self._fitted_light()[1])

    def _fitted_light(self) -> tuple[Light | None, np.ndarray]:
        """The light and what it leaves of the views' exposures [V, 3]."""
        if self._fitted is None or self._fitted[0] != self.iteration:
            self._fitted = self.iteration, *self._fit_light()
        return self._fitted[1:]

    @torch.no_grad()
    def _fit_light(self) -> tuple[Light | None, np.ndarray]:
        unexplained = np.zeros((len(self._stamps), 3))
        if not self._lit:
            return None, unexplained
        if not self.config.exposure:
            return Light(*self._light["light"].tolist(), self.scene_depth), unexplained
        exposures = self._light["exposures"].cpu().numpy().astype(np.float64)
        brightness = []
        for view in self._views[: len(exposures)]:
            output = self._render(*self._matrices([view.camera]), (view.camera.width, view.camera.height))
            image, depth, alpha = output.colors[0], output.depths[0], output.alphas[0]
            if self.config.light:
                rays = directions(view.camera, self.device)
                image = image * falloff(features(depth, alpha, rays, self.scene_depth), self._light["light"])[..., None]
            where = alpha > 0.5 if view.mask is None else (alpha > 0.5) & (view.mask > 0)
            brightness.append(float(log_brightness(image, where)))
        response, levels, residuals = photometry.fit_exposure(exposures, np.array(brightness))
        return Light(*self._light["light"].tolist(), self.scene_depth, *map(float, levels), response), residuals

    @property
    def cameras(self) -> list[Camera]:
        """The training cameras at training size, without right ones."""
        return [view.camera for view in self._views[: len(self._stamps)]]

    @property
    def stamps(self) -> list[int]:
        """When the views were taken that are trained on, nanoseconds; views that were left out are not among them."""
        return self._stamps

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
            "model": self._detached().tensors(),
            "optimizer": self._optimizer.state,
            "gradients": self._gradients,
            "shown": self._shown,
            "light": {name: value.detach() for name, value in self._light.items()},
            "light_optimizer": self._light_optimizer.state,
            "generator": self._generator.get_state(),
            "noise": self._noise.get_state(),
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
            theirs = state["config"]
            differing = [name for name in {**mine, **theirs} if name != "device" and mine.get(name) != theirs.get(name)]
            if differing or state["stamps"] != self._stamps:
                what = f"other options ({', '.join(differing)})" if differing else "other views"
                raise SequenceError(f"{path}: the checkpoint was made with {what}; use the same or start anew")
            iteration, order = int(state["iteration"]), [int(view) for view in state["order"]]
            if iteration < 0 or not set(order) <= set(range(len(self._views))):
                raise ValueError("it names views or an iteration that there cannot be")
            if {name: value.shape for name, value in state["light"].items()} != {name: value.shape for name, value in self._light.items()}:
                raise ValueError("its light is not that of these views")
            generator = torch.Generator()
            generator.set_state(state["generator"].cpu())
            noise = generator if self.device == "cpu" else torch.Generator(self.device)
            if noise is not generator:
                noise.set_state(state["noise"].cpu())
            self._set_model(GaussianModel(**state["model"]))  # what is refused was so before: a training goes on as it was
            self._optimizer.state = state["optimizer"]
            self._set_light(**state["light"])
            self._light_optimizer.state = state["light_optimizer"]
            self._gradients, self._shown = state["gradients"], state["shown"]
            self._generator, self._noise = generator, noise
            self.iteration, self._order = iteration, order
        except SequenceError:
            raise
        except Exception as error:  # a damaged file can make the unpickler raise anything
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise SequenceError(f"{path}: not a readable checkpoint ({reason})") from error

    # --------------------------------------------------------------- training

    def run(self, on_progress: Callable[[Progress], bool | None] | None = None, every: int = 20) -> GaussianModel:
        """Train to the end; ``on_progress`` is called every few iterations and may return False to stop early.

        Out of memory, training goes on with images of half the size, as long as they are not tiny.
        """
        while self.iteration < self.config.iterations:
            try:
                self.step()
            except torch.OutOfMemoryError:
                if self._frames[0].camera.width < 2 * _NARROWEST:
                    raise
                self._halve()
                continue
            due = self.iteration % every == 0 or self.iteration == self.config.iterations
            if on_progress and due and on_progress(self.progress) is False:
                break
        return self.model

    def _halve(self) -> None:
        """Go on with images of half the size."""
        width = self._frames[0].camera.width // 2
        log.warning("out of memory: going on with images %d pixels wide; fewer max_gaussians may help, too", width)
        self._recordings, self._views = {}, []
        torch.cuda.empty_cache()
        self._load([shrink(frame, width) for frame in self._frames])

    def step(self) -> None:
        """One iteration: a training view, a virtual view, one step of the optimiser."""
        config = self.config
        if not self._order:
            self._order = torch.randperm(len(self._views), generator=self._generator).tolist()
        view = self._views[self._order.pop()]
        virtual = None
        if config.virtual_every and self.iteration % config.virtual_every == 0 and len(self._stamps) > 1:
            virtual = self._virtual_camera(view.exposure)
        inputs = self._inputs(view, virtual)
        self._optimizer.set_rate("means", self._step_size)
        seldom = bool(config.lambda_flat) and self.iteration % _SELDOM == 0
        self._last_loss = self._descend(seldom, inputs)
        self.iteration += 1
        with torch.no_grad():
            refining = self.iteration <= _LAST_REFINEMENT * config.iterations
            if refining and self.iteration % config.refine_every == 0:
                self._refine()
            if config.densification == "mcmc" and self.iteration % _SELDOM == 0:
                self._explore()

    @property
    def _step_size(self) -> float:
        """Learning rate of the means, metres."""
        return _RATES["means"] * self.scene_depth * self.config.learning_rate * 0.01 ** (self.iteration / self.config.iterations)

    def _inputs(self, view: _View, virtual: Camera | None) -> _Inputs:
        viewmats, Ks = self._matrices([view.camera] if virtual is None else [view.camera, virtual])
        carried, beside = None, self._views[view.exposure]
        if virtual is not None and self.config.lambda_pearson and beside.depth is not None:
            carried = _carried_depth(beside, viewmats[1])
        rays = directions(view.camera, self.device) if self.config.light else None
        return _Inputs(viewmats, Ks, view.image, view.exposure_index, view.mask, view.depth, rays, carried)

    def _matrices(self, cameras: list[Camera]) -> tuple[Tensor, Tensor]:
        """Of cameras, viewmats [C, 4, 4] and Ks [C, 3, 3]."""
        # Without waiting for what the GPU still does.
        tensor = lambda matrices: torch.from_numpy(np.stack(matrices).astype(np.float32)).to(self.device, non_blocking=True)
        return tensor([camera.viewmat for camera in cameras]), tensor([camera.K for camera in cameras])

    def _descend(self, seldom: bool, inputs: _Inputs) -> Tensor:
        """One step of the optimisers, with or without the ``seldom`` terms in the loss that is returned; on a GPU replayed as one piece."""
        function = functools.partial(self._descend_once, seldom)
        if self.device == "cpu":
            return function(*inputs)
        key = (seldom, *(None if x is None else x.shape for x in inputs))
        if key not in self._recordings:
            self._recordings[key] = Recording(function)
        with torch.cuda.device(self.device):
            return self._recordings[key](*inputs)

    def _descend_once(self, seldom: bool, *inputs: Tensor | None) -> Tensor:
        config, view = self.config, _Inputs(*inputs)
        cameras, (height, width) = len(view.viewmats), view.image.shape[:2]
        wanted = {name: value for name, value in (self._parameters | self._light).items() if value.requires_grad}
        absgrad = None
        if config.densification != "mcmc":
            wanted["absgrad"] = absgrad = torch.zeros(cameras, len(self._parameters["means"]), 2, device=self.device, requires_grad=True)
        masks = None
        if view.mask is not None:
            masks = torch.stack([view.mask > 0, *[torch.ones_like(view.mask, dtype=torch.bool)] * (cameras - 1)])
        output = self._render(view.viewmats, view.Ks, (width, height), masks, absgrad)
        loss = self._view_loss(output, view)
        if cameras > 1:
            loss = loss + self._virtual_loss(output, view)
        if seldom:
            loss = loss + _SELDOM * config.lambda_flat * losses.depth_extent(self._current(), self._eye).mean()
        if config.light:
            loss = loss + _LIGHT_ANCHOR * ((self._light["light"] - self._light_prior) ** 2).sum()
        gradients = dict(zip(wanted, torch.autograd.grad(loss, list(wanted.values()))))
        if config.confined:
            for name, values in self._parameters.items():
                gradients[name] = gradients[name] * self._shown.view(-1, *[1] * (values.ndim - 1))
        if absgrad is not None:
            across, down = gradients["absgrad"][0].unbind(1)
            steepness = torch.hypot(across * (width / 2), down * (height / 2))
            if config.confined:
                steepness = steepness * self._shown
            self._gradients += torch.stack([steepness, (steepness > 0).to(steepness.dtype)])
        for optimizer in (self._optimizer, self._light_optimizer):
            optimizer.step({name: gradients[name] for name in optimizer.parameters})
        with torch.no_grad():
            # Nothing holds the size of Gaussians where every view is masked; one that grew would smear the deformed scene.
            self._parameters["log_scales"].clamp_(max=math.log(_LARGEST * self.scene_depth))
            if config.exposure:
                # All exposures up and all colours down is the same picture, except for tissue that no view sees.
                self._light["exposures"] += self._exposure_level - self._light["exposures"].mean(0)
        return loss.detach()

    def _render(
        self, viewmats: Tensor, Ks: Tensor, size: tuple[int, int], masks: Tensor | None = None, absgrad: Tensor | None = None
    ) -> RenderOutput:
        """Images of cameras, width × height pixels."""
        model = self._current()
        tensors = model.means, model.quats, model.scales, model.opacities, model.sh
        return rasterize(*tensors, viewmats, Ks, *size, masks=masks, absgrad=absgrad)

    def _virtual_camera(self, index: int) -> Camera:
        """Paper eq. 8: a random camera between a view and its nearest view."""
        first, second = (self._views[i].camera for i in (index, self._nearest[index]))
        alpha = torch.rand((), generator=self._generator).item()
        return first.at(interpolate_pose(first.pose, second.pose, alpha))

    def _view_loss(self, output: RenderOutput, view: _Inputs) -> Tensor:
        """Paper eq. 7: photometric, depth, distortion and total variation of a training view, the first camera."""
        config = self.config
        image, depth, alpha, distortion = (images[0] for images in output[:4])
        if (gain := self._gain(depth, alpha, view)) is not None:
            image = image * gain
        total = losses.photometric(image, view.image, view.mask, config.lambda_ssim)
        if view.depth is not None and config.lambda_depth:
            off = losses.depth_l1(depth, view.depth, view.mask, alpha, config.lambda_opaque)
            total = total + config.lambda_depth / self.scene_depth * off
        if view.depth is not None and config.lambda_pearson:
            total = total + config.lambda_pearson * losses.pearson(depth, view.depth, view.mask)
        return total + self._regularization(depth, distortion, view.mask)

    def _gain(self, depth: Tensor, alpha: Tensor, view: _Inputs) -> Tensor | None:
        """What light and exposure make of a training view's colours [H, W, 1 or 3]; None without them."""
        gain = None
        if self.config.light:
            gain = falloff(features(depth, alpha, view.rays, self.scene_depth), self._light["light"])[..., None]
        if self.config.exposure:
            exposure = self._light["exposures"].index_select(0, view.exposure).exp()[None]
            gain = exposure if gain is None else gain * exposure
        return gain

    def _virtual_loss(self, output: RenderOutput, view: _Inputs) -> Tensor:
        """Paper eq. 9: distortion and total variation from a virtual camera, the second one."""
        total = self._regularization(output.depths[1], output.distortions[1], None)
        if view.carried is not None:
            total = total + self.config.lambda_pearson * losses.pearson(output.depths[1], view.carried, None)
        return total

    def _regularization(self, depth: Tensor, distortion: Tensor, mask: Tensor | None) -> Tensor:
        total = depth.new_zeros(())
        if self.config.lambda_dist:
            total = total + self.config.lambda_dist * losses.masked_mean(distortion, mask)
        if self.config.lambda_tv:
            total = total + self.config.lambda_tv * losses.total_variation(depth, mask)
        return total / self.scene_depth

    # --------------------------------------------------------------- Gaussians

    def _set_model(self, model: GaussianModel) -> None:
        """Start optimising a model with a fresh optimiser."""
        for recording in self._recordings.values():
            recording.forget()
        self._parameters = {name: tensor.clone().requires_grad_() for name, tensor in _parameters(model).items()}
        self._optimizer = Adam(self._parameters, {name: self.config.learning_rate * rate for name, rate in _RATES.items()})
        self._shown = self._shown_now()
        # Σ of image gradients and number of views that had any, since the last refinement.
        self._gradients = torch.zeros(2, len(model), device=self.device)

    @torch.no_grad()
    def _shown_now(self) -> Tensor:
        """Which Gaussians' centres any view shows [N], 1 or 0."""
        shown = torch.zeros(len(self._parameters["means"]), dtype=torch.bool, device=self.device)
        for view in self._views:
            (viewmat,), (K,) = self._matrices([view.camera])
            shown |= losses.seen_at(self._parameters["means"], viewmat, K, view.mask, view.image.shape[:2])[1]
        return shown.float()

    def _set_light(self, light: Tensor, exposures: Tensor) -> None:
        """Start optimising the light [4] and the logarithm of the exposures [V, 3], as far as there are any."""
        self._fitted = None  # the iteration that light and drift were asked for last, and what they were
        self._light = {
            "light": light.clone().requires_grad_(self.config.light),
            "exposures": exposures.clone().requires_grad_(self.config.exposure),
        }
        learnt = {name: value for name, value in self._light.items() if value.requires_grad}
        self._light_optimizer = Adam(learnt, {"light": _LIGHT_RATE, "exposures": _EXPOSURE_RATE})

    def _current(self) -> GaussianModel:
        """The model made of the parameters, through which gradients flow."""
        p = self._parameters
        sh = torch.cat([p["sh_base"], p["sh_rest"]], 1) if "sh_rest" in p else p["sh_base"]
        return GaussianModel(p["means"], p["quats"], p["log_scales"], p["logit_opacities"], sh)

    def _refine(self) -> None:
        """Relocate and add Gaussians, carrying the optimiser's state of those that stay."""
        config, model = self.config, self._detached()
        if config.densification == "mcmc":
            model, source, fresh = mcmc.refine(model, config.growth, config.max_gaussians, self._generator)
        else:
            total, count = self._gradients
            model, source, fresh = mcmc.split_and_clone(
                model, total / count.clamp_min(1), self.scene_depth, config.max_gaussians, self._generator
            )
            if config.densification == "proximity":
                model, others, added = mcmc.unpool(model, config.max_gaussians)
                source, fresh = source[others], fresh[others] | added
        states = self._optimizer.state
        self._set_model(model)
        for name, state in states.items():
            moved = {key: value[source] if value.ndim else value for key, value in state.items()}
            for key in ("exp_avg", "exp_avg_sq"):
                moved[key][fresh] = 0
            self._optimizer.state[name] = moved

    def _explore(self) -> None:
        """Move faint Gaussians about at random."""
        model, faint = self._current(), slice(None)
        if self.device == "cpu":  # a GPU is sooner done with all than it has told how many they are
            faint = (model.opacities < 10 * mcmc.DEAD_OPACITY).nonzero()[:, 0]
            if not len(faint):
                return
            model = model.select(faint)
        # Variances are in m²: divided by the squared depth of the scene, steps are those of a scene of depth 1.
        scale = _SELDOM**0.5 * _NOISE * self._step_size / self.scene_depth**2
        self._parameters["means"][faint] += mcmc.exploration_noise(model, scale, self._noise)

    # --------------------------------------------------------------- inputs

    def _load(self, frames: list[Frame]) -> None:
        """Train on these from now on."""
        self._frames, self._fitted = frames, None
        self._views = [self._to_device(frame, i) for i, frame in enumerate(frames)]
        if self.config.right_views:
            self._views += [self._to_device(right_view(f), i) for i, f in enumerate(frames) if f.right is not None]

    def _to_device(self, frame: Frame, exposure: int) -> _View:
        tensor = lambda array: torch.tensor(array, dtype=torch.float32, device=self.device)
        tissue = frame.tissue
        return _View(
            frame.camera,
            tensor(frame.image) / 255,
            None if frame.depth is None else tensor(frame.depth),
            None if tissue.all() else tensor(tissue),
            exposure,
            torch.tensor([exposure], device=self.device),
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
    if "shown" not in state:
        raise ValueError("another version made it; start anew")
    moments, lights = state["optimizer"], state["light_optimizer"]  # of each parameter, by its name
    tensors = [*state["model"].values(), *state["light"].values(), state["gradients"], state["shown"]]
    tensors += [value for values in [*moments.values(), *lights.values()] for value in values.values()]
    if sum(tensor.numel() * tensor.element_size() for tensor in tensors) > size:  # views of less
        raise ValueError("it claims more than it holds")
    if any(tensor.dtype != torch.float32 or tensor.is_meta or not tensor.isfinite().all() for tensor in tensors):
        raise ValueError("its tensors are not of finite float32 numbers")
    parameters = _parameters(GaussianModel(**state["model"]))  # none without Gaussians
    count, shown = len(parameters["means"]) if parameters else 0, state["shown"]
    if not count or state["gradients"].shape != (2, count) or shown.shape != (count,) or not ((shown == 0) | (shown == 1)).all():
        raise ValueError("the gradients do not fit the model")
    optimized = parameters | {name: state["light"][name] for name in lights}
    expected = {name: {"step": (), "exp_avg": x.shape, "exp_avg_sq": x.shape} for name, x in optimized.items()}
    if {name: {key: value.shape for key, value in values.items()} for name, values in (moments | lights).items()} != expected:
        raise ValueError("the state of the optimiser does not fit the model")
    return state


def _as_long_as_worth(config: ReconstructionConfig, contradiction: float) -> ReconstructionConfig:
    """The options with a number of iterations: fewer and smaller steps where views contradict each other (pixels, NaN = unknown).

    Details that contradict each other can only be learnt by heart, one view by one, and make other views worse.
    """
    share = float(np.clip(_SHARP / max(contradiction, 1e-9), _LEAST_TRAINING, 1)) if np.isfinite(contradiction) else _LEAST_TRAINING
    iterations = max(round(_MOST_ITERATIONS * share), 1)
    if np.isfinite(contradiction):
        log.info("views contradict each other by %.2f pixels that no depth explains: %d iterations", contradiction, iterations)
    else:
        log.info("no two views with depth show the same, so nobody can tell how well views agree: %d iterations", iterations)
    return dataclasses.replace(config, iterations=iterations, learning_rate=config.learning_rate * share)


def _checked(points: ScenePoints) -> ScenePoints:
    """Scene points that somebody gave."""
    shape, error = np.shape(points.positions), np.asarray(points.error)
    if len(shape) != 2 or shape[1] != 3 or np.shape(points.colors) != shape or error.shape not in ((), shape[:1]):
        raise SequenceError("scene points: give positions and colours as arrays [N, 3], and errors [N] or one for all")
    if not (np.isfinite(points.positions).all() and np.isfinite(points.colors).all()):
        raise SequenceError("scene points: some positions or colours are not finite; leave those out")
    if not (np.isfinite(error) & (error > 0)).all():
        raise SequenceError("scene points: errors are relative and above zero; leave points without one out")
    return points


def _showing(frames: list[Frame]) -> list[Frame]:
    """The views that show tissue: not masked whole, not mostly white, not black."""
    kept, out = [], {}
    for frame in frames:
        pixels = frame.image.reshape(-1, 3) if frame.mask is None else frame.image[frame.mask > 0]
        if not len(pixels):
            out.setdefault("masked", []).append(frame)
        elif (pixels.min(-1) >= _WHITE).mean() > _MOSTLY:
            out.setdefault("overexposed", []).append(frame)
        elif (pixels.max(-1) <= _BLACK).mean() > _ALMOST_ALL:
            out.setdefault("black", []).append(frame)
        else:
            kept.append(frame)
    if not kept:
        raise SequenceError(_NOTHING[max(out, key=lambda reason: len(out[reason]))])
    for reason, views in out.items():
        log.warning("views at %s left out: %s", ", ".join(f"{frame.stamp_ns * 1e-9:.3f} s" for frame in views), reason)
    return kept


def _consistent(frames: list[Frame], config: ReconstructionConfig, points: ScenePoints | None) -> tuple[list[Frame], ScenePoints]:
    """The views with their depth prior, without those whose poses contradict the others, and scene points: the given ones, or
    triangulated."""
    matches = match_features(frames)
    # What the eyes of one view tell of depth does not hang on the poses of the views: it helps to judge them.
    by_stereo = config.depth in ("auto", "stereo") and any(frame.right is not None for frame in frames)
    if by_stereo or not (wrong := misposed(frames, matches)):
        found = triangulate(frames, matches) if points is None else points
        prior = with_depth_prior(frames, found, config)
        if not by_stereo or not (wrong := misposed(prior, matches)):
            return prior, found
    stamps = ", ".join(f"{frames[i].stamp_ns * 1e-9:.3f} s" for i in wrong)
    log.warning("views at %s left out: their poses contradict what they share with the others, or much of the tissue moved", stamps)
    return _consistent([frame for i, frame in enumerate(frames) if i not in wrong], config, points)


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


def _carried_depth(view: _View, viewmat: Tensor) -> Tensor:
    """The prior of a view as another camera [4, 4] of its kind sees it [H, W], metres; 0 where nothing falls."""
    height, width = view.depth.shape
    v, u = (view.depth > 0).nonzero(as_tuple=True)
    K, pose = (torch.tensor(matrix).to(viewmat) for matrix in (view.camera.K, view.camera.pose))
    z = view.depth[v, u]
    local = torch.stack([(u + 0.5 - K[0, 2]) / K[0, 0] * z, (v + 0.5 - K[1, 2]) / K[1, 1] * z, z], 1)
    index, inside, z = losses.seen_at(local, viewmat @ pose, K, None, view.depth.shape)
    carried = torch.full((height * width,), math.inf, device=z.device).scatter_reduce(0, index[inside], z[inside], "amin")
    return torch.where(carried.isfinite(), carried, 0).view(height, width)


def _nearest_views(frames: list[Frame]) -> list[int]:
    """Index of each view's nearest other view (by optical centre); its own for a single view."""
    centres = np.array([frame.camera.position for frame in frames])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(distance, math.inf)
    return distance.argmin(1).tolist()
