"""Cross-validation of the number of Gaussians and of the weight of depth: which predict left-out pixels best after a short training."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import PreparedScene, TrainingView
from endo_sim_ros.reconstruction.stage_configs import CapacityConfig
from endo_sim_ros.reconstruction.trainer import Trainer

_FEWEST = 500  # left-out pixels, and pixels of known depth, that a trial needs
_EVERY = 10  # iterations between two reports


def choose_capacity(
    scene: PreparedScene,
    config: ReconstructionConfig,
    start: Callable[[PreparedScene], PreparedScene],
    progress: StageProgress,
    changes: Sequence[Callable[[PreparedScene, CapacityConfig], "Change"]],
) -> PreparedScene:
    """The scene with those of the changes, one after the other, that predict left-out pixels better.

    With few views many Gaussians memorise noise, and few smooth away detail; depth that is wrong keeps them from where the views have
    the tissue. All are trained briefly on the middle of the views without some blocks of pixels; Gaussians that memorise, or are where no
    tissue is, predict those blocks worse. Where no trial can be made, because too little is seen or memory is short, the scene stays as it
    is, and a decision says so.

    Args:
        scene: Views with depth prior, `max_gaussians`, `fading` and `trust`.
        config: Options.
        start: Places the Gaussians that a training of a scene starts from.
        progress: Reported to by iterations.
        changes: What is tried.

    Raises:
        Cancelled: If the work is not wanted any more.
    """
    options = config.capacity
    generator = np.random.default_rng(config.seed)
    views = [_middle(view, options.share) for view in scene.views]
    left_out = [_blocks(view, options.left_out, options.block, generator) for view in views]
    seen = [replace(view, mask=np.uint8(255) * ((view.tissue > 0) & ~pixels)) for view, pixels in zip(views, left_out)]
    known = sum(int(((view.surface > 0) & (view.tissue > 0)).sum()) for view in seen)
    if min(known, sum(int(pixels.sum()) for pixels in left_out)) < _FEWEST:
        return scene.decided("no trial of the training: the middle of the views shows too little tissue of known depth", logging.INFO)
    trial = replace(scene, frames=(), views=tuple(seen), iterations=min(options.iterations, scene.iterations))
    total, trained = (1 + len(changes)) * trial.iterations, 0

    def loss(candidate: PreparedScene) -> float:
        nonlocal trained
        most = max(int(candidate.max_gaussians * options.share**2), 1)
        trained_on = replace(trial, max_gaussians=most, fading=candidate.fading, trust=candidate.trust)
        trainer = Trainer(start(trained_on), replace(config, schedule=0))
        while trainer.iteration < trainer.iterations:
            if trainer.iteration % _EVERY == 0:
                progress(trained + trainer.iteration, total)
            trainer.step()
        trained += trainer.iterations
        return trainer.photometric_error(left_out)

    try:
        least = loss(scene)
        for change in changes:
            other = change(scene, options)
            tried = loss(other.scene)
            better = tried < (1 - other.margin) * least
            told = f"loss of left-out pixels {least:.4f}, and {tried:.4f} {other.tried}: {other.taken if better else other.left}"
            scene, least = (other.scene if better else scene).decided(told, logging.INFO), min(least, tried)
    except (SequenceError, torch.OutOfMemoryError) as error:
        reason = "out of memory" if isinstance(error, torch.OutOfMemoryError) else str(error)
        return scene.decided(f"no trial of the training: {reason}", logging.INFO)
    progress(total, total)
    return scene


class Change(NamedTuple):
    """What is tried: the scene with it, by what share the loss must fall, and what is said of the trial, where it is taken and where it
    is left."""

    scene: PreparedScene
    margin: float
    tried: str
    taken: str
    left: str


def fewer_gaussians(scene: PreparedScene, options: CapacityConfig) -> Change:
    """Fewer Gaussians, which fade faster."""
    fewer = replace(scene, max_gaussians=max(int(options.fewer * scene.max_gaussians), 1), fading=options.fading * scene.fading)
    return Change(
        fewer,
        0.0,
        f"with {options.fewer:.0%} of the Gaussians and {options.fading:g} times the weight of fading",
        f"{fewer.max_gaussians} Gaussians at most, weight of fading × {options.fading:g}",
        f"{scene.max_gaussians} Gaussians at most",
    )


def less_depth(scene: PreparedScene, options: CapacityConfig) -> Change:
    """Less weight of the depth prior."""
    less = replace(scene, trust=options.less_depth * scene.trust)
    return Change(
        less,
        options.depth_margin,
        f"with {options.less_depth:g} times the weight of depth",
        f"weight of depth × {options.less_depth:g}",
        "weight of depth as it is",
    )


def _middle(view: TrainingView, share: float) -> TrainingView:
    """The middle of a view, that share of its width and height."""
    height, width = view.image.shape[:2]
    rows, columns = (slice((n - max(round(share * n), 1)) // 2, (n + max(round(share * n), 1)) // 2) for n in (height, width))
    K = view.camera.K.copy()
    K[:2, 2] -= columns.start, rows.start
    cut = lambda image: None if image is None else np.ascontiguousarray(image[rows, columns])
    camera = replace(view.camera, K=K, width=columns.stop - columns.start, height=rows.stop - rows.start)
    images = {name: cut(getattr(view, name)) for name in ("image", "mask", "depth", "depth_prior")}
    return replace(view, camera=camera, right=None, right_K=None, baseline=None, **images)


def _blocks(view: TrainingView, share: float, size: int, generator: np.random.Generator) -> np.ndarray:
    """Pixels [H, W] of tissue in a share of the blocks of size × size pixels."""
    tissue = view.tissue > 0
    height, width = tissue.shape
    chosen = generator.random((-(-height // size), -(-width // size))) < share
    return np.kron(chosen, np.ones((size, size), bool))[:height, :width] & tissue
