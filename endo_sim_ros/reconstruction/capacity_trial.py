"""Cross-validation of the number of Gaussians for few views: which number predicts left-out pixels best after a short training."""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import PreparedScene, TrainingView
from endo_sim_ros.reconstruction.trainer import Trainer

_FEWEST = 500  # left-out pixels, and pixels of known depth, that a trial needs
_ENOUGH, _MOST = 750, 0.5  # pixels that are left out of small pictures, and the largest share of all that they may be
_EVERY = 10  # iterations between two reports


def choose_capacity(
    scene: PreparedScene,
    config: ReconstructionConfig,
    start: Callable[[PreparedScene], PreparedScene],
    progress: StageProgress,
) -> PreparedScene:
    """The scene with its own number of Gaussians, or with fewer that fade faster: whichever predicts left-out pixels better.

    With few views many Gaussians memorise noise, and few smooth away detail. Both are trained briefly on the middle of the views without
    some blocks of pixels; Gaussians that memorise predict those blocks worse. Where no trial can be made, because too little is seen or
    memory is short, the scene stays as it is, and a decision says so.

    Args:
        scene: Views with depth prior, `max_gaussians` and `fading`.
        config: Options.
        start: Places the Gaussians that a training of a scene starts from.
        progress: Reported to by iterations.

    Raises:
        Cancelled: If the work is not wanted any more.
    """
    options = config.capacity
    generator = np.random.default_rng(config.seed)
    views = [_middle(view, options.share) for view in scene.views]
    share = max(options.left_out, _ENOUGH / max(sum(int((view.tissue > 0).sum()) for view in views), 1))  # of small pictures more
    left_out = [_blocks(view, min(share, _MOST), options.block, generator) for view in views]
    seen = [replace(view, mask=np.uint8(255) * ((view.tissue > 0) & ~pixels)) for view, pixels in zip(views, left_out)]
    known = sum(int(((view.surface > 0) & (view.tissue > 0)).sum()) for view in seen)
    if min(known, sum(int(pixels.sum()) for pixels in left_out)) < _FEWEST:
        few = "too little tissue of known depth" if known < _FEWEST else "too little tissue"
        return scene.decided(f"no trial of fewer Gaussians: the middle of the views shows {few}", logging.INFO)
    trial = replace(scene, frames=(), views=tuple(seen), iterations=min(options.iterations, scene.iterations))
    fewer = replace(scene, max_gaussians=max(int(options.fewer * scene.max_gaussians), 1), fading=options.fading * scene.fading)
    losses = []
    for candidate in (scene, fewer):
        most = max(int(candidate.max_gaussians * options.share**2), 1)
        try:
            trainer = Trainer(start(replace(trial, max_gaussians=most, fading=candidate.fading)), replace(config, schedule=0))
            while trainer.iteration < trainer.iterations:
                if trainer.iteration % _EVERY == 0:
                    progress(len(losses) * trainer.iterations + trainer.iteration, 2 * trainer.iterations)
                trainer.step()
        except (SequenceError, torch.OutOfMemoryError) as error:
            reason = "out of memory" if isinstance(error, torch.OutOfMemoryError) else str(error)
            return scene.decided(f"no trial of fewer Gaussians: {reason}", logging.INFO)
        losses.append(trainer.photometric_error(left_out))
    progress(2 * trial.iterations, 2 * trial.iterations)
    chosen = fewer if losses[1] < losses[0] else scene
    decided = f"{chosen.max_gaussians} Gaussians at most" + (f", weight of fading × {options.fading:g}" if chosen is fewer else "")
    tried = f"with {options.fewer:.0%} of the Gaussians and {options.fading:g} times the weight of fading"
    sentence = f"loss of left-out pixels {losses[0]:.4f}, and {losses[1]:.4f} {tried}: {decided}"
    return chosen.decided(sentence, logging.INFO)


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
