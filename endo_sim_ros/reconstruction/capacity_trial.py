"""Cross-validation of what a training starts from: which number of Gaussians, and which depth, predicts left-out pixels best."""

import logging
from collections.abc import Callable, Sequence
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
    fewer = replace(scene, max_gaussians=max(int(options.fewer * scene.max_gaussians), 1), fading=options.fading * scene.fading)
    losses = _left_out_losses((scene, fewer), config, start, progress)
    if isinstance(losses, str):
        return scene.decided(f"no trial of fewer Gaussians: {losses}", logging.INFO)
    chosen = fewer if losses[1] < losses[0] else scene
    decided = f"{chosen.max_gaussians} Gaussians at most" + (f", weight of fading × {options.fading:g}" if chosen is fewer else "")
    tried = f"with {options.fewer:.0%} of the Gaussians and {options.fading:g} times the weight of fading"
    sentence = f"loss of left-out pixels (less is better) {losses[0]:.4f}, and {losses[1]:.4f} {tried}: {decided}"
    return chosen.decided(sentence, logging.INFO)


def choose_start(
    scene: PreparedScene,
    config: ReconstructionConfig,
    start: Callable[[PreparedScene], PreparedScene],
    progress: StageProgress,
) -> PreparedScene:
    """The scene with its depth, which one lens tells, or with none, trained from scene points as plain 3DGS is, where that predicts
    left-out pixels much better. Arguments and errors are those of `choose_capacity`.

    Between scene points depth is guessed: something thin in front of the tissue is taken for a part of what is behind it. Light that
    falls with such depth is as wrong, and trained beside what nothing holds to a surface it is worse than none.
    """
    plain = stripped_of_depth(scene)
    losses = _left_out_losses((scene, plain), config, start, progress)
    if isinstance(losses, str):
        return scene.decided(f"no trial without depth: {losses}", logging.INFO)
    chosen = plain if losses[1] < config.capacity.without_depth * losses[0] else scene
    without = "training starts from scene points, without depth and light, and adds Gaussians where gradients are steep"
    kept = f"depth is kept, unless the second is below {config.capacity.without_depth:g} times the first"
    decided = without if chosen is plain else kept
    sentence = f"loss of left-out pixels (less is better) {losses[0]:.4f}, and {losses[1]:.4f} from scene points alone: {decided}"
    return chosen.decided(sentence, logging.INFO)


def stripped_of_depth(scene: PreparedScene) -> PreparedScene:
    """The scene without the depth that one lens tells, and without the light that was fitted to it."""
    views = tuple(replace(view, depth=None, depth_prior=None) for view in scene.views)
    return replace(scene, views=views, depth_source="none", without_depth=True, light=np.zeros(4), fading=1.0)


def _left_out_losses(
    candidates: Sequence[PreparedScene],
    config: ReconstructionConfig,
    start: Callable[[PreparedScene], PreparedScene],
    progress: StageProgress,
) -> list[float] | str:
    """Loss of left-out pixels after a short training of each candidate, which have the same pictures; or why there can be no trial."""
    options, scene = config.capacity, candidates[0]
    generator = np.random.default_rng(config.seed)
    middles = [[_middle(view, options.share) for view in candidate.views] for candidate in candidates]
    share = max(options.left_out, _ENOUGH / max(sum(int((view.tissue > 0).sum()) for view in middles[0]), 1))  # of small pictures more
    left_out = [_blocks(view, min(share, _MOST), options.block, generator) for view in middles[0]]
    known = sum(int(((view.surface > 0) & (view.tissue > 0) & ~pixels).sum()) for view, pixels in zip(middles[0], left_out))
    if min(known, sum(int(pixels.sum()) for pixels in left_out)) < _FEWEST:
        return f"the middle of the views shows too little tissue{' of known depth' if known < _FEWEST else ''}"
    iterations, losses = min(options.iterations, scene.iterations), []
    # In so short a training tilted cameras make few Gaussians look better than they are in the whole one.
    config = replace(config, schedule=0, tilted=replace(config.tilted, every=0))
    for candidate, middle in zip(candidates, middles):
        seen = tuple(replace(view, mask=np.uint8(255) * ((view.tissue > 0) & ~pixels)) for view, pixels in zip(middle, left_out))
        most = max(int(candidate.max_gaussians * options.share**2), 1)
        try:
            trainer = Trainer(start(replace(candidate, frames=(), views=seen, iterations=iterations, max_gaussians=most)), config)
            while trainer.iteration < trainer.iterations:
                if trainer.iteration % _EVERY == 0:
                    progress(len(losses) * trainer.iterations + trainer.iteration, len(candidates) * trainer.iterations)
                trainer.step()
        except (SequenceError, torch.OutOfMemoryError) as error:
            return "out of memory" if isinstance(error, torch.OutOfMemoryError) else str(error)
        losses.append(trainer.photometric_error(left_out))
    progress(len(candidates) * iterations, len(candidates) * iterations)
    return losses


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
