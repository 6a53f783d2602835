"""gsplat's own trainers as methods of an evaluation, where gsplat is installed: what its `simple_trainer.py` does, SH of degree 0."""

import importlib.util
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree

from endo_sim_ros.core.compressed_ply import SH_C0
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.words import counted
from endo_sim_ros.reconstruction import Progress, ReconstructionConfig, ScenePoints, shrink
from endo_sim_ros.reconstruction.camera_errors import CameraErrors
from endo_sim_ros.reconstruction.losses import photometric
from endo_sim_ros.reconstruction.photometry import Drift

STRATEGIES = {"gsplat": "DefaultStrategy", "gsplat-mcmc": "MCMCStrategy"}
"""Methods by name, and the strategy of gsplat that densifies."""

_ITERATIONS = 7000  # after which simple_trainer saves and evaluates first
_RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "colors": 2.5e-3}
_DECAY = 0.01  # of the rate of the means, until the end
_OPACITY, _SCALE, _REGULARISED = (0.1, 0.5), (1.0, 0.1), (0.0, 0.01)  # at first, and weight of both; of default and mcmc


def check_installed(name: str) -> None:
    """Raise `ConfigError` if gsplat is not there."""
    if importlib.util.find_spec("gsplat") is None:
        raise ConfigError(f"--presets {name}: gsplat is not installed; pip install gsplat (it needs an NVIDIA GPU)")


class GsplatTrainer:
    """A training by gsplat's rasteriser, strategy and defaults, with the interface of `Trainer` that an evaluation needs.

    Args:
        views: Training views.
        points: Scene points to start from.
        config: Of it counts `image_width`, `iterations` and `seed`; `device` must be a GPU.
        name: A key of `STRATEGIES`.

    Raises:
        SequenceError: If there are no scene points.
    """

    motion = None
    """To these trainers all tissue is at rest."""
    camera_errors = CameraErrors()
    """They take poses and the lens as they are."""

    def __init__(self, views: Sequence[Frame], points: ScenePoints, config: ReconstructionConfig, name: str) -> None:
        import gsplat  # pyright: ignore[reportMissingImports]  (optional)

        if len(points.positions) < 4:
            raise SequenceError(f"{name}: {counted(len(points.positions), 'scene point')} to start from; there must be 4 or more")
        self.config, self.iterations = config, _ITERATIONS
        self._views = [shrink(view, config.image_width) for view in views]
        self._rasterization, self._device = gsplat.rasterization, config.device
        torch.manual_seed(config.seed)
        self._generator = torch.Generator().manual_seed(config.seed)
        depths = np.concatenate([view.camera.project(points.positions)[1] for view in self._views])
        self._unit = float(np.median(depths[depths > 0]))  # the scene is scaled to depth 1, as simple_trainer normalises scenes
        mcmc = name == "gsplat-mcmc"
        self._regularised = _REGULARISED[mcmc]
        self._parameters = self._initial(points, _OPACITY[mcmc], _SCALE[mcmc])
        self._optimizers = {
            key: torch.optim.Adam([{"params": value, "lr": _RATES[key], "name": key}], eps=1e-15) for key, value in self._parameters.items()
        }
        self._strategy = getattr(gsplat, STRATEGIES[name])()
        self._strategy.check_sanity(self._parameters, self._optimizers)
        self._state = self._strategy.initialize_state() if mcmc else self._strategy.initialize_state(scene_scale=1.0)
        self._mcmc = mcmc

    def _initial(self, points: ScenePoints, opacity: float, scale: float) -> torch.nn.ParameterDict:
        positions, tensor = points.positions / self._unit, lambda x: torch.as_tensor(x, dtype=torch.float32, device=self._device)
        apart = np.sqrt((KDTree(positions).query(positions, 4)[0][:, 1:] ** 2).mean(1)).clip(1e-6)
        values = {
            "means": tensor(positions),
            "scales": tensor(np.log(apart * scale)[:, None].repeat(3, 1)),
            "quats": torch.rand(len(positions), 4, device=self._device),
            "opacities": torch.full((len(positions),), opacity, device=self._device).logit(),
            "colors": tensor((points.colors - 0.5) / SH_C0)[:, None],
        }
        return torch.nn.ParameterDict({key: torch.nn.Parameter(value) for key, value in values.items()})

    @property
    def model(self) -> GaussianModel:
        """The current model, metres."""
        p = {key: value.detach().clone() for key, value in self._parameters.items()}
        return GaussianModel(p["means"] * self._unit, p["quats"], p["scales"] + np.log(self._unit), p["opacities"], p["colors"])

    @property
    def drift(self) -> Drift:
        """None: this trainer knows no exposure."""
        return Drift([view.stamp_ns for view in self._views], np.zeros((len(self._views), 3)))

    def run(self, on_progress: Callable[[Progress], Any], every: int = 100) -> GaussianModel:
        """Train to the end."""
        p, tensor, order = self._parameters, lambda x: torch.as_tensor(x, dtype=torch.float32, device=self._device), []
        images = [tensor(view.image / 255.0) for view in self._views]
        masks = [None if view.mask is None else tensor(view.mask > 0) for view in self._views]
        viewmats = [view.camera.viewmat.copy() for view in self._views]
        for matrix in viewmats:
            matrix[:3, 3] /= self._unit
        viewmats, Ks = [tensor(matrix) for matrix in viewmats], [tensor(view.camera.K) for view in self._views]
        for step in range(_ITERATIONS):
            order = order or torch.randperm(len(images), generator=self._generator).tolist()
            i = order.pop()
            height, width = images[i].shape[:2]
            rate = _RATES["means"] * _DECAY ** (step / _ITERATIONS)
            self._optimizers["means"].param_groups[0]["lr"] = rate
            drawn, _, info = self._rasterization(
                p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), p["colors"], viewmats[i][None], Ks[i][None],
                width, height, sh_degree=0, packed=False,
            )  # fmt: skip
            if not self._mcmc:
                self._strategy.step_pre_backward(p, self._optimizers, self._state, step, info)
            loss = photometric(drawn[0], images[i], masks[i], 0.2)
            if self._regularised:
                loss = loss + self._regularised * (p["opacities"].sigmoid().mean() + p["scales"].exp().mean())
            loss.backward()
            for optimizer in self._optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            extra = {"lr": rate} if self._mcmc else {"packed": False}
            self._strategy.step_post_backward(p, self._optimizers, self._state, step, info, **extra)
            if (step + 1) % every == 0:
                on_progress(Progress(step + 1, _ITERATIONS, float(loss.detach()), len(p["means"])))
        return self.model
