"""Train on a few views of a bag and measure the rest."""

import logging
from pathlib import Path

import numpy as np
from rich.progress import Progress as ProgressBar

from endo_sim_ros.cameras import save_cameras
from endo_sim_ros.evaluation import figures, metrics
from endo_sim_ros.gaussians import GaussianModel, save_ply
from endo_sim_ros.reconstruction import Progress, ReconstructionConfig, Trainer, select_keyframes, shrink
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.bag import read_bag
from endo_sim_ros.sequences.frames import Frame

log = logging.getLogger(__name__)

_STRIPS = 3  # held-out views shown in the picture


def reconstruct_and_measure(bag: Path, out: Path, config: ReconstructionConfig) -> dict[str, float]:
    """Reconstruct a bag, save the model, and return mean figures over the views that were not trained on."""
    out.mkdir(parents=True, exist_ok=True)  # before the long work
    frames = list(read_bag(bag))
    chosen = select_keyframes(frames, config.keyframes)
    log.info("%d views, training on %d", len(frames), len(chosen))
    trainer = Trainer([frames[index] for index in chosen], config)
    with ProgressBar() as bar:
        task = bar.add_task("reconstructing", total=config.iterations)

        def on_progress(progress: Progress) -> None:
            text = f"reconstructing, {progress.gaussians} Gaussians, loss {progress.loss:.4f}"
            bar.update(task, completed=progress.iteration, description=text)

        model = trainer.run(on_progress)
    save_ply(model, out / "model.ply")
    save_cameras([frames[index].camera for index in chosen], out / "cameras.json")
    trainer.save_checkpoint(out / "checkpoint.pt")
    held_out = [shrink(frame, config.image_width) for index, frame in enumerate(frames) if index not in chosen]
    held_out = [frame for frame in held_out if frame.mask is None or frame.mask.any()]
    if not held_out:
        log.info("no view was held out that shows tissue; lower keyframes")
        return {}
    figures_of, pictures = _measure(model, held_out, config)
    figures.write_png(out / "held_out.png", figures.sheet(pictures, columns=4))
    for name, value in figures_of.items():
        log.info("%-28s %.4g", name, value)
    return figures_of


def _measure(model: GaussianModel, frames: list[Frame], config: ReconstructionConfig):
    renderer = DeformableRenderer(model, None, RenderingConfig(device=config.device, image_width=0))
    rows, pictures = [], []
    shown = {int(i) for i in np.linspace(0, len(frames) - 1, min(_STRIPS, len(frames)))}
    for index, frame in enumerate(frames):
        mask, reference = frame.mask, frame.image
        image, depth = renderer.render(frame.camera)
        row = {
            "PSNR [dB]": metrics.psnr(image, reference, mask),
            "PSNR, gain fitted [dB]": metrics.psnr(metrics.gain_fitted(image, reference, mask), reference, mask),
            "SSIM": metrics.ssim(image, reference, mask),
        }
        if frame.depth is not None:
            row["depth RMSE [mm]"] = 1e3 * metrics.depth_rmse(depth, frame.depth, mask)
        rows.append(row)
        if index in shown:
            difference = np.abs(image.astype(int) - reference).clip(0, 85).astype(np.uint8) * 3
            pictures += [
                (f"held-out view {index}", reference),
                (f"rendered, {row['PSNR [dB]']:.1f} dB", image),
                ("difference × 3", difference),
                ("rendered depth", figures.color_depth(depth)),
            ]
    names = dict.fromkeys(name for row in rows for name in row)  # each once, in order
    means = {name: float(np.nanmean([row.get(name, np.nan) for row in rows])) for name in names}
    return means | {"held-out views": float(len(rows))}, pictures
