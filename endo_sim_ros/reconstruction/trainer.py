"""Optimises the Gaussians of a prepared scene against its views (paper eq. 6), virtual cameras (eq. 7, 8) and tilted ones."""

import dataclasses
import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera, interpolate_pose, rigid_pose
from endo_sim_ros.core.device import pick_device, single_threaded_torch
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.light import SURFACE, Light, directions
from endo_sim_ros.core.reflections import DARKEST, add_glints, facing, seen_colors, stored_strengths
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.reconstruction import hidden, losses, photometry
from endo_sim_ros.reconstruction.appearance import Appearance
from endo_sim_ros.reconstruction.checkpoint import identity, read_checkpoint, reading, write_checkpoint
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.device_views import DeviceView, carried, inside, matrices, project, reprojected_prior, shown
from endo_sim_ros.reconstruction.gloss import lobes, strongest_sheen
from endo_sim_ros.reconstruction.learnt_motion import LearntMotion
from endo_sim_ros.reconstruction.optimizer import PARAMETERS, Adam, model_of, parameters_of
from endo_sim_ros.reconstruction.scene import PreparedScene, TrainingView, shrink
from endo_sim_ros.reconstruction.ssim import ssim
from endo_sim_ros.reconstruction.strategies import STRATEGIES
from endo_sim_ros.reconstruction.triangulation import nearest_views
from endo_sim_ros.sequences.recording import spread
from endo_sim_ros.splatting import RenderOutput, rasterize
from endo_sim_ros.splatting.graph_capture import GraphCapture

log = logging.getLogger(__name__)


class _Inputs(NamedTuple):
    """What is new in an iteration, on the compute device; C = 2 with a virtual or a tilted camera, else 1."""

    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    image: Tensor  # [H, W, 3] of the training view, as are mask, prior and rays
    exposure: Tensor  # [1] int64, index of the training view
    mask: Tensor | None  # [H, W]
    prior: Tensor | None  # [H, W] m
    rays: Tensor | None  # [3, H, W], for the light
    paths: Tensor | None  # [parts, 3] m, of the tissue that moves by itself
    virtual_prior: Tensor | None  # [H, W] depth prior as the virtual camera sees it
    turn: Tensor | None  # [4, 4] from the frame of a tilted camera, which the second one then is, to that of the view


_COLORS = {"sh_base", "sh_rest", "gloss"}
_GLINT = 0.03  # of white, from which on a pixel glints: eight grey levels, more than noise
_LOOKS = 16  # views in which what others hide is looked for: as in the measurements; all of 100 would take long on a CPU
_RISING = 0.1  # share of the iterations, the last ones, in which opacities that fell would not rise again


class Progress(NamedTuple):
    """What a running training reports."""

    iteration: int
    iterations: int
    loss: float
    gaussians: int


class Trainer:
    """Trains the Gaussian model of a prepared scene.

    Args:
        scene: What `prepare` returned.
        config: The options that it was prepared with.
    """

    def __init__(self, scene: PreparedScene, config: ReconstructionConfig) -> None:
        self.config = config
        self._depth_weight = config.lambda_depth * (1.0 if scene.depth_is_recorded else config.unmeasured_depth)
        self._fade(scene.fading)
        self._terms = losses.active_terms(config)
        self.scene_depth = scene.depth
        self.device = pick_device(config.device)
        self.stamps = [view.stamp_ns for view in scene.views]
        """When the views were taken that are trained on, nanoseconds; views that were left out are not among them."""
        self.iteration = 0
        self.iterations = scene.iterations
        self.camera_errors = scene.camera_errors
        """By how much recorded poses are off in the course of the recording, and the lens in all of it."""
        self._nearest = nearest_views(scene.views, 1)
        self._load(scene.views)
        middle = np.mean([camera.position for camera in self.cameras], 0)
        extent = 1.1 * max(float(np.linalg.norm(camera.position - middle)) for camera in self.cameras)
        self._unit = extent if config.unit == "cameras" and extent else scene.depth  # metres
        self._schedule = config.schedule or scene.iterations
        self._generator = torch.Generator().manual_seed(config.seed)
        # Drawn where it is needed: a GPU that waits for numbers stands still.
        self._noise = self._generator if self.device == "cpu" else torch.Generator(self.device).manual_seed(config.seed)
        self._order: list[int] = []
        self._captures: dict[tuple, GraphCapture] = {}
        self._last_loss = torch.zeros(())
        self._without_depth = bool(scene.without_depth)
        densification = "gradient" if self._without_depth else config.densification
        self._lit = config.light and not self._without_depth
        self._tilted_every = 0 if config.sh_degree else config.tilted.every  # colours that turn with the view differ from aside
        self._lobes = lobes(config.gloss)
        self._strategy = STRATEGIES[densification](getattr(config, densification), scene.max_gaussians, self._unit)
        learnt = dataclasses.replace(config, light=self._lit, exposure=config.exposure and not scene.fixed_exposure)
        self.appearance = Appearance(scene.light, scene.exposures, scene.depth, learnt, self.device, scene.views[0].shoulder)
        means = scene.model.means.numpy().astype(np.float64)
        self._moving = None
        if scene.motion is not None and scene.views[0].paths is not None:  # views of a trial are in the mean position
            self._moving = LearntMotion(scene.motion, means, config.watch, self.device)
        self._set_model(scene.model.to(self.device))

    # ------------------------------------------------------------------ state

    @property
    def model(self) -> GaussianModel:
        """The current model, detached, with its light; at the end of the training also with what is bared as tissue is strained."""
        return dataclasses.replace(self._detached(), light=self.light, bared=self._bared_shifts())

    @property
    def motion(self) -> TissueMotion | None:
        """How the tissue moves by itself, as it was learnt by now; the model has it in its mean position. None: the views show it there."""
        return None if self._moving is None else self._moving.motion

    @property
    def light(self) -> Light | None:
        """The light, with the exposure that was learnt from the training views."""
        return self._fitted_light()[0]

    @property
    def drift(self) -> photometry.Drift:
        """How exposure changed in the course of the recording beyond what the light explains."""
        return photometry.Drift(self.stamps, self._fitted_light()[1])

    @property
    def cameras(self) -> list[Camera]:
        """The training cameras at training size."""
        return [view.camera for view in self._device_views]

    @property
    def progress(self) -> Progress:
        """How far the training is; on a GPU this waits for it."""
        return Progress(self.iteration, self.iterations, float(self._last_loss), len(self.parameters["means"]))

    @torch.no_grad()
    def photometric_error(self, pixels: Sequence[np.ndarray]) -> float:
        """Mean photometric loss of the training views at pixels [H, W] (bool) of each, such as their masks leave out."""
        total, count = 0.0, 0
        for view, chosen in zip(self._device_views, pixels, strict=True):
            output = self.render(view.viewmats, view.Ks, (view.camera.width, view.camera.height), paths=view.paths)[1]
            rays = directions(view.camera, self.device) if self._lit else None
            color, _ = self._exposed(output, rays, view.index_tensor)
            where = torch.tensor(chosen, device=self.device)
            l1, unlike = (color - view.image).abs()[where], 1 - ssim(color, view.image)[where]
            total += float(torch.lerp(l1, unlike, self.config.lambda_ssim).mean(1, dtype=torch.float64).sum())
            count += len(l1)
        return total / count

    def save_checkpoint(self, path: str | Path) -> None:
        """Write model, optimiser and random state; a training that loads them goes on as if never interrupted."""
        state = {
            "config": identity(self.config),
            "stamps": self.stamps,
            "without_depth": self._without_depth,
            "max_gaussians": self._strategy.limit,
            "fading": self._fading,
            "iteration": self.iteration,
            "order": self._order,
            "model": self._detached().tensors(),
            "optimizer": self.optimizer.state,
            "strategy": self._strategy_state,
            "motion": self._motion_state,
            "motion_optimizer": {} if self._moving is None else self._moving.optimizer.state,
            "seen": self._seen,  # by where Gaussians were when their number last changed, as is the next
            "strongest": self._strongest,
            "light": {name: value.detach() for name, value in self.appearance.tensors.items()},
            "light_optimizer": self.appearance.optimizer.state,
            "generator": self._generator.get_state(),
            "noise": self._noise.get_state(),
        }
        write_checkpoint(state, path)

    def load_checkpoint(self, path: str | Path) -> None:
        """Continue from a checkpoint of the same views and options.

        Raises:
            SequenceError: If the file is not a checkpoint, or one of other views or options.
        """
        with reading(path):
            state = read_checkpoint(path, self.config, self.device)
            if state["stamps"] != self.stamps:
                raise SequenceError(f"{path}: the checkpoint was made with other views; use the same or start anew")
            limit, fading = int(state["max_gaussians"]), float(state["fading"])
            if limit < 1 or not 0 < fading < math.inf:
                raise ValueError("it names a number of Gaussians or a fading that there cannot be")
            if state["without_depth"] != self._without_depth:
                raise SequenceError(
                    f"{path}: training began with{'out' * (not self._without_depth)} depth; prepare views so, or start anew"
                )
            iteration, order = int(state["iteration"]), [int(view) for view in state["order"]]
            if iteration < 0 or not set(order) <= set(range(len(self._device_views))):
                raise ValueError("it names views or an iteration that there cannot be")
            shapes = lambda tensors: {name: value.shape for name, value in tensors.items()}
            if shapes(state["light"]) != shapes(self.appearance.tensors):
                raise ValueError("its light is not that of these views")
            if not 0 <= float(state["light"]["shoulder"]) <= 1:
                raise ValueError("its camera has a tone curve that there cannot be")
            if shapes(state["strategy"]) != shapes(self._strategy.initialize_state(len(state["model"]["means"]), "meta")):
                raise ValueError("the state of the strategy does not fit the model")
            motion, mine, count = state["motion"], self._motion_state, len(state["model"]["means"])
            expected = {name: (count, *x.shape[1:]) if name in ("found", "weights") else x.shape for name, x in mine.items()}
            if shapes(motion) != expected or mine and not torch.equal(motion["paths"], mine["paths"]):
                raise ValueError("its tissue moves otherwise")
            if self._moving is not None and state["motion_optimizer"].keys() != self._moving.tensors.keys():
                raise ValueError("the state of the optimiser does not fit the motion")
            generator = torch.Generator()
            generator.set_state(state["generator"].cpu())
            noise = generator if self.device == "cpu" else torch.Generator(self.device)
            if noise is not generator:
                noise.set_state(state["noise"].cpu())
            if self._moving is not None:
                self._moving.found, self._moving.weights = motion["found"], motion["weights"]
                self._moving.set(motion["shares"])
                self._moving.optimizer.state = state["motion_optimizer"]
            self._set_model(GaussianModel(**state["model"]))  # what is refused was so before: a training goes on as it was
            self.optimizer.state, self._strategy_state = state["optimizer"], state["strategy"]
            self._seen, self._strongest = state["seen"], state["strongest"]
            self.appearance.set(**state["light"])
            self.appearance.optimizer.state = state["light_optimizer"]
            self._generator, self._noise = generator, noise
            self._strategy.limit = limit  # as was decided then, should a trial decide otherwise now
            self._fade(fading)
            self.iteration, self._order, self._fitted, self._bared = iteration, order, None, None

    @property
    def _motion_state(self) -> dict[str, Tensor]:
        """What a checkpoint has of how tissue moves by itself: what is learnt, of each Gaussian, and the paths in all views."""
        if self._moving is None:
            return {}
        paths = torch.stack([view.paths for view in self._device_views if view.paths is not None])  # [V, parts, 3]
        learnt = {name: value.detach() for name, value in self._moving.tensors.items()}
        return learnt | {"found": self._moving.found, "weights": self._moving.weights, "paths": paths}

    def _fade(self, factor: float) -> None:
        """Weigh opacity and size of the Gaussians by so many times what the options say."""
        weights = {name: factor * getattr(self.config, name) for name in ("lambda_opacity", "lambda_scale")}
        self._fading, self._weights = factor, dataclasses.replace(self.config, lambda_depth=self._depth_weight, **weights)

    def _detached(self) -> GaussianModel:
        return model_of({name: tensor.detach().clone() for name, tensor in self.parameters.items()})

    def _fitted_light(self) -> tuple[Light | None, np.ndarray]:
        """The light and what it leaves of the views' exposures [V, 3]."""
        if self._fitted is None or self._fitted[0] != self.iteration:
            size = lambda camera: (camera.width, camera.height)
            look = lambda view: self.render(view.viewmats, view.Ks, size(view.camera), paths=view.paths)[1]
            self._fitted = self.iteration, *self.appearance.fitted(self._device_views, look)
        return self._fitted[1:]

    # --------------------------------------------------------------- training

    def run(self, on_progress: Callable[[Progress], bool | None] | None = None, every: int = 20) -> GaussianModel:
        """Train to the end; ``on_progress`` is called every few iterations and may return False to stop early.

        Out of memory, training goes on with images of half the size, as long as they are not tiny.
        """
        while self.iteration < self.iterations:
            try:
                self.step()
            except torch.OutOfMemoryError:
                if self._views[0].camera.width < 2 * self.config.smallest_width:
                    raise
                self._halve()
                continue
            due = self.iteration % every == 0 or self.iteration == self.iterations
            if on_progress and due and on_progress(self.progress) is False:
                break
        model = self.model
        if self.config.extrapolation and self.config.extrapolated.hole_error and model.light is not None:
            log.info(
                "holes of pictures %s", "take the colour around them" if model.light.filled else "stay black: training views show dark ones"
            )
        return model

    def _halve(self) -> None:
        """Go on with images of half the size."""
        width = self._views[0].camera.width // 2
        log.warning("out of memory: going on with images %d pixels wide; fewer max_gaussians may help, too", width)
        self._captures, self._device_views = {}, []
        torch.cuda.empty_cache()
        self._load([shrink(view, width) for view in self._views])

    @single_threaded_torch()
    def step(self) -> None:
        """One iteration: a training view, a virtual or a tilted camera, one step of the optimiser."""
        config = self.config
        if not self._order:
            self._order = torch.randperm(len(self._device_views), generator=self._generator).tolist()
        view = self._device_views[self._order.pop()]
        virtual = tilted = None
        due = self.iteration >= config.virtual_from and config.virtual_every and self.iteration % config.virtual_every == 0
        if due and len(self.stamps) > 1:
            virtual = self._virtual_camera(view.index)
        elif self._tilted_every and not self._settles and self.iteration % self._tilted_every == 0 and view.prior is not None:
            tilted = self._tilted_camera(view.camera)
        self.optimizer.set_rate("means", self._step_size)
        if "gloss" in self.parameters:
            self.optimizer.set_rate("gloss", self._gloss_rate)
        if self._moving is not None:
            self._moving.begin_step(self.iteration / self._schedule, self._step_size)
        if self._kept is not None:
            share = self._dropout
            self._kept.uniform_(generator=self._noise).ge_(share).div_(1 - share)
        self._last_loss = self._descend(self._inputs(view, virtual, tilted))
        self.iteration += 1
        with torch.no_grad():
            if self.iteration <= config.refine_until * self._schedule:
                if self.iteration > config.refine_from and self.iteration % config.refine_every == 0:
                    self.refine()
                if self.iteration <= (1 - _RISING) * self.iterations:
                    self._strategy.reset(self.parameters, self.optimizer.state, self.iteration)
            self._strategy.perturb(self.parameters, self.iteration, self._step_size, self._noise)

    @property
    def _step_size(self) -> float:
        """Learning rate of the means, metres."""
        config, rates = self.config, self.config.rates
        progress = min(self.iteration / self._schedule, 1.0)
        return rates.means * self._unit * config.learning_rate * rates.means_decay**progress

    @property
    def _gloss_rate(self) -> float:
        """Learning rate of what reflects."""
        config, rates = self.config, self.config.rates
        settled = (self.iteration / self._schedule - rates.gloss_decay_from) / (1 - rates.gloss_decay_from)
        return rates.gloss * config.learning_rate * rates.gloss_decay ** min(max(settled, 0.0), 1.0)

    @property
    def _dropout(self) -> float:
        """Share of the Gaussians that an iteration leaves out: the longer views are trained on, the more they are memorised."""
        return 0.0 if self._settles else self.config.dropout * (self.iteration / self._schedule)

    @property
    def _settles(self) -> bool:
        """Whether these are the last iterations, without dropout and tilted cameras, in which the model settles."""
        return self.iteration >= self.config.refine_until * self._schedule

    @property
    def _sh_count(self) -> int:
        """Number of coefficients of the degree that the spherical harmonics have by now."""
        config = self.config
        degree = min(config.sh_degree, (self.iteration + 1) // config.sh_every) if config.sh_every else config.sh_degree
        return (degree + 1) ** 2

    def _virtual_camera(self, index: int) -> Camera:
        """Paper eq. 7: a random camera between a view and its nearest view."""
        first, second = (self._device_views[i].camera for i in (index, self._nearest[index][0]))
        alpha = torch.rand((), generator=self._generator).item()
        return first.at(interpolate_pose(first.pose, second.pose, alpha))

    def _tilted_camera(self, camera: Camera) -> Camera:
        """A camera turned to any side about the point straight ahead of another one that is as far away as the scene."""
        way, share = torch.rand(2, generator=self._generator).tolist()
        angle = math.radians(self.config.tilted.angle) * math.sqrt(share)  # evenly over the cone
        turn = cv2.Rodrigues(angle * np.array([math.cos(2 * math.pi * way), math.sin(2 * math.pi * way), 0.0]))[0]
        middle = np.array([0.0, 0.0, self.scene_depth])
        return camera.at(camera.pose @ rigid_pose(turn, middle - turn @ middle))

    def _inputs(self, view: DeviceView, virtual: Camera | None, tilted: Camera | None) -> _Inputs:
        second = virtual or tilted
        viewmats, Ks = (view.viewmats, view.Ks) if second is None else matrices([view.camera, second], self.device)
        virtual_prior = turn = None
        if tilted is not None:
            turn = torch.from_numpy((view.camera.viewmat @ tilted.pose).astype(np.float32)).to(self.device, non_blocking=True)
        if virtual is not None and view.prior is not None and any(term.of_virtual and term.needs_prior for term in self._terms):
            virtual_prior = reprojected_prior(view.prior, view.camera, viewmats[1])
        rays = directions(view.camera, self.device) if self._lit else None
        return _Inputs(viewmats, Ks, view.image, view.index_tensor, view.mask, view.prior, rays, view.paths, virtual_prior, turn)

    def _descend(self, inputs: _Inputs) -> Tensor:
        """One step of the optimisers, and the loss before it; on a GPU replayed as one piece."""
        if self.device == "cpu":
            return self._descend_once(*inputs)
        key = (self._sh_count, *(None if x is None else x.shape for x in inputs))
        if key not in self._captures:
            self._captures[key] = GraphCapture(self._descend_once)
        with torch.cuda.device(self.device):
            return self._captures[key](*inputs)

    def _descend_once(self, *inputs: Tensor | None) -> Tensor:
        config, view = self.config, _Inputs._make(inputs)
        cameras, (height, width) = len(view.viewmats), view.image.shape[:2]
        beside = (self.appearance,) if self._moving is None else (self.appearance, self._moving)
        learnt = [self.parameters, *(each.tensors for each in beside)]
        wanted = {name: value for tensors in learnt for name, value in tensors.items() if value.requires_grad}
        absgrad = None
        if self._strategy.wants_absgrad:
            wanted["absgrad"] = absgrad = torch.zeros(cameras, len(self.parameters["means"]), 2, device=self.device, requires_grad=True)
        masks = None
        if view.mask is not None:
            masks = torch.stack([view.mask > 0, *[torch.ones_like(view.mask, dtype=torch.bool)] * (cameras - 1)])
        loss = self._loss(view, *self.render(view.viewmats, view.Ks, (width, height), masks, absgrad, self._kept, view.paths))
        gradients = dict(zip(wanted, torch.autograd.grad(loss, list(wanted.values()))))
        for name in _COLORS & gradients.keys():  # by their rims alone, what no view shows would take on any colour
            gradients[name] = gradients[name] * self._seen.view(-1, *[1] * (gradients[name].ndim - 1))
        if absgrad is not None:
            across, down = gradients["absgrad"][0].unbind(1)
            steepness = torch.hypot(across * (width / 2), down * (height / 2))
            self._strategy.step_post_backward(self._strategy_state, steepness)
        for optimizer in (self.optimizer, *(each.optimizer for each in beside)):
            optimizer.step({name: gradients[name] for name in optimizer.parameters})
        with torch.no_grad():
            self.parameters["log_scales"].clamp_(max=math.log(config.largest * self.scene_depth))
            if "gloss" in self.parameters:
                strengths = self.parameters["gloss"][:, 6:]
                torch.minimum(strengths, self._strongest, out=strengths)
                self.parameters["sh_base"].clamp_(min=(DARKEST - 0.5) / SH_C0)  # what is black would stay so
        self.appearance.hold()
        return loss.detach()

    def render(
        self,
        viewmats: Tensor,
        Ks: Tensor,
        size: tuple[int, int],
        masks: Tensor | None = None,
        absgrad: Tensor | None = None,
        kept: Tensor | None = None,
        paths: Tensor | None = None,
    ) -> tuple[GaussianModel, RenderOutput, Tensor]:
        """The model, its images of one camera or two, width × height pixels, and of two the colours without glints [2, H, W, 3].

        ``kept`` are factors on the opacities; without ``paths`` tissue is at rest. Where tissue reflects, both cameras have the colours
        that the first one sees, and that one alone has glints.
        """
        model = self._displaced(model_of(self.parameters), paths)
        opacities = model.opacities if kept is None else model.opacities * kept
        sh, films = model.sh[:, : self._sh_count], None
        if model.gloss is not None:
            eye = -viewmats[0, :3, :3].T @ viewmats[0, :3, 3]
            cosines, films = facing(model, eye)
            sh = seen_colors(dataclasses.replace(model, light=self._lobes), cosines)
        tensors = model.means, model.quats, model.scales, opacities, sh
        options = {"masks": masks, "absgrad": absgrad, "signed": self._strategy.signed, "extras": films}
        if len(viewmats) == 1:
            output = rasterize(*tensors, viewmats, Ks, *size, glints=self._lobes.glint_sharpness, **options)
            return model, output, output.colors
        output = rasterize(*tensors, viewmats, Ks, *size, **options)
        plain = output.colors
        if output.extras is not None:
            first = slice(1)
            films, alphas, sharpness = output.extras[first], output.alphas[first], self._lobes.glint_sharpness
            seen = add_glints(plain[first], films, alphas, viewmats[first], Ks[first], sharpness)
            output = output._replace(colors=torch.cat([seen, plain[1:]]), extras=None)
        return model, output, plain

    def _loss(self, view: _Inputs, model: GaussianModel, output: RenderOutput, plain: Tensor) -> Tensor:
        """Paper eq. 6 of a training view, the first camera, and eq. 8 of a virtual camera or `_tilted_loss`, the second one."""
        config = self.config
        images = lambda camera: (model, *(images[camera] for images in (output.depths, output.alphas, output.distortions)))
        of_scene = {"scene_depth": self.scene_depth, "seen": self._seen}
        seen = losses.Rendering(*images(0), mask=view.mask, prior=view.prior, **of_scene)
        color, gain = self._exposed(output, view.rays, view.exposure)
        white = math.inf if model.gloss is None else config.views.white / 255
        loss = losses.photometric(color, view.image, view.mask, config.lambda_ssim, white)
        loss = losses.regularized(loss, self._terms, seen, self._weights)
        if view.turn is not None:
            loss = loss + config.tilted.weight * self._tilted_loss(view, output, plain, gain)
        elif len(view.viewmats) > 1:
            seen = losses.Rendering(*images(1), mask=None, prior=view.virtual_prior, **of_scene)
            loss = losses.regularized(loss, self._terms, seen, self._weights, virtual=True)
        return loss + config.light_anchor * self.appearance.changes() if self._lit else loss

    def _tilted_loss(self, view: _Inputs, output: RenderOutput, plain: Tensor, gain: Tensor | None) -> Tensor:
        """Photometric loss of the tilted camera, by the share of its picture that the view tells of.

        A pixel should have the colour of the view where its depth lies there, with the view's gain, if the view's depth prior has a surface
        at that depth. What is white or glints in the view tells nothing: a picture less its glints would confirm these, right or wrong.
        Gradients flow to the tilted camera's colours alone.
        """
        assert view.prior is not None and view.turn is not None
        with torch.no_grad():
            gain = torch.ones_like(view.image) if gain is None else gain.expand_as(view.image)
            glints = (output.colors[0] - plain[0]) * gain
            known = (view.prior > 0) & (view.image < self.config.views.white / 255).all(-1) & (glints < _GLINT).all(-1)
            known = known if view.mask is None else known & (view.mask > 0)
            images = [view.image.permute(2, 0, 1), gain.permute(2, 0, 1), view.prior[None], known[None].float()]
            depth = output.depths[1] / output.alphas[1].clamp_min(1e-3)
            found, z = carried(torch.cat(images), view.Ks[0], view.turn, depth)
            image, gain = found[:3].permute(1, 2, 0), found[3:6].permute(1, 2, 0)
            prior, whole = found[6:]
            there = (whole > 0.999) & ((z - prior).abs() < self.config.depth_tolerance * prior) & (output.alphas[1] > SURFACE)
            there = there.float()
        return there.mean() * losses.photometric(self.appearance.toned(plain[1] * gain), image, there, self.config.lambda_ssim)

    def _exposed(self, output: RenderOutput, rays: Tensor | None, exposure: Tensor) -> tuple[Tensor, Tensor | None]:
        """The first camera's colours [H, W, 3] in the light and with the exposure of a training view, and what these multiply them by."""
        gain = self.appearance.gain(output.depths[0], output.alphas[0], rays, exposure)
        return self.appearance.toned(output.colors[0] if gain is None else output.colors[0] * gain), gain

    # --------------------------------------------------------------- Gaussians

    def _displaced(self, model: GaussianModel, paths: Tensor | None) -> GaussianModel:
        """The model where its tissue is at the time of `TissueMotion.paths`; without them in its mean position."""
        return model if self._moving is None or paths is None else self._moving.displaced(model, paths)

    @single_threaded_torch()
    def _bared_shifts(self) -> Tensor | None:
        """What is added to the colours of what others hide as it is bared [N, 3], see `hidden`; None before the end."""
        if not self.config.hidden_below or self.config.sh_degree or self.iteration < self.iterations:
            return None
        if self._bared is None:
            model, views = self._detached(), self._device_views

            def seen(view: DeviceView) -> hidden.View:
                there = self._displaced(model, view.paths).detach()
                size, matrices = (view.camera.width, view.camera.height), (view.viewmats[0], view.Ks[0])
                # Masks do not count: the model has tissue behind an instrument, and others are in front of it there, too.
                return there, inside(*project(*matrices, there.means), *size), *matrices, size

            self._bared = hidden.bared_shifts(model.sh, map(seen, spread(views, _LOOKS)), self.config.hidden_below)
        return self._bared

    def _set_model(self, model: GaussianModel) -> None:
        """Start optimising a model with a fresh optimiser."""
        for capture in self._captures.values():
            capture.invalidate()
        self.parameters = {name: tensor.clone().requires_grad_() for name, tensor in parameters_of(model).items()}
        self.optimizer = Adam(self.parameters, {name: self.config.learning_rate * getattr(self.config.rates, name) for name in PARAMETERS})
        self._strategy_state = self._strategy.initialize_state(len(model), self.device)
        # Of each Gaussian, 0 where an iteration leaves it out, else what makes up for those; a captured step reads what it is by then.
        self._kept = torch.ones(len(model), device=self.device) if self.config.dropout else None
        self._seen = self._seen_by_views(model) if self._tells_seen else torch.ones(len(model), device=self.device)
        self._strongest = torch.empty(0) if model.gloss is None else self._strongest_lobes(model)

    @property
    def _tells_seen(self) -> bool:
        """Whether Gaussians that views show are treated otherwise than those that none shows, as extrapolated ones."""
        return bool(self.config.extrapolation or self.config.lambda_opacity or self.config.lambda_scale)

    @torch.no_grad()
    def _seen_by_views(self, model: GaussianModel) -> Tensor:
        """Which Gaussians lie where some training view shows tissue [N], 1.0 or 0.0."""
        seen = torch.zeros(len(model), dtype=torch.bool, device=self.device)
        for view in self._device_views:
            seen |= shown(view, self._displaced(model, view.paths).means)
        return seen.float()

    @torch.no_grad()
    def _strongest_lobes(self, model: GaussianModel) -> Tensor:
        """The largest values of the strengths of sheen and glints in `gloss` [N, 2] of a model that has it."""
        options = self.config.gloss
        eyes = torch.stack([-view.viewmats[0, :3, :3].T @ view.viewmats[0, :3, 3] for view in self._device_views])
        sheen = strongest_sheen(model, eyes, options)
        return stored_strengths(torch.stack([sheen, torch.full_like(sheen, options.strongest)], 1))

    @torch.no_grad()
    def refine(self) -> None:
        """Add, move and remove Gaussians, keeping the optimiser's state of those that stay."""
        model, source, fresh = self._strategy.refine(self._detached(), self._strategy_state, self._generator, self.iteration)
        states = {}
        for name, state in self.optimizer.state.items():
            states[name] = {key: value[source] if value.ndim else value for key, value in state.items()}
            for key in ("exp_avg", "exp_avg_sq"):
                states[name][key][fresh] = 0
        if self._moving is not None:
            self._moving.refine(source)
        if len(source) != len(self.parameters["means"]):
            self._set_model(model)
            self.optimizer.state.update(states)
            return
        # As many as before go where captured steps find them: to capture those anew takes as long as dozens of them.
        changed = [(self.parameters, parameters_of(model)), *((self.optimizer.state[name], state) for name, state in states.items())]
        changed.append((self._strategy_state, self._strategy.initialize_state(len(model), self.device)))
        for old, new in changed:
            for name, tensor in old.items():
                tensor.copy_(new[name])
        if self._tells_seen:
            self._seen.copy_(self._seen_by_views(model))
        if model.gloss is not None:
            self._strongest.copy_(self._strongest_lobes(model))

    def _load(self, views: Sequence[TrainingView]) -> None:
        """Train on these from now on."""
        self._views = views
        self._bared = None
        self._fitted = None  # the light that was asked for last, with its iteration
        self._device_views = [DeviceView.of(view, index, self.device) for index, view in enumerate(views)]
