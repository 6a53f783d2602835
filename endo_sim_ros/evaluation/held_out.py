"""Views that were not trained on, measured."""

import contextlib
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core import drawing
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.tissue_motion import MovingModel, TissueMotion
from endo_sim_ros.core.words import counted
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.lpips import Lpips
from endo_sim_ros.reconstruction import Trainer, shrink
from endo_sim_ros.reconstruction.camera_errors import CameraErrors
from endo_sim_ros.reconstruction.photometry import Drift
from endo_sim_ros.reconstruction.scene import unusable
from endo_sim_ros.reconstruction.triangulation import points_in_view
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.recording import Recording

log = logging.getLogger(__name__)

_STRIPS = 3  # held-out views shown in the picture
_SAME_SURFACE = 0.03  # relative difference of depth within which two views see the same surface


class Figure(NamedTuple):
    """What one figure of a view is."""

    heading: str
    unit: str
    digits: int  # worth showing, after the point

    @property
    def title(self) -> str:
        """Heading with the unit."""
        return f"{self.heading} [{self.unit}]" if self.unit else self.heading


_OF_PIXELS = {
    "psnr": Figure("PSNR", "dB", 2),
    "psnr_gain": Figure("PSNR, gain fitted", "dB", 2),
    "ssim": Figure("SSIM", "", 3),
    "lpips_alex": Figure("LPIPS alex", "", 3),
    "lpips_vgg": Figure("LPIPS vgg", "", 3),
}
FIGURES: dict[str, Figure] = {
    **_OF_PIXELS,
    "seen_share": Figure("seen", "%", 1),
    **{f"seen_{name}": figure._replace(heading=f"{figure.heading}, seen") for name, figure in _OF_PIXELS.items()},
    "depth_rmse": Figure("depth RMSE", "m", 5),
    "depth_rmse_scaled": Figure("depth RMSE, median scaled", "m", 5),
    "seen_depth_rmse": Figure("depth RMSE, seen", "m", 5),
    "depth_share": Figure("has depth", "%", 1),
    "points_depth": Figure("depth at scene points", "m", 5),
    "psnr_unmasked": Figure("PSNR, unmasked", "dB", 2),
    "ssim_unmasked": Figure("SSIM, unmasked", "", 3),
}
"""All figures of a view by their names in files. Over the pixels of its mask, except the unmasked; `seen` over those
of them that a training view saw."""


def measure(
    image: np.ndarray,
    depth: np.ndarray,
    frame: Frame,
    seen: np.ndarray | None = None,
    lpips: Sequence[Lpips] = (),
    points: np.ndarray | None = None,
) -> dict[str, float]:
    """The figures of a rendered view that can be told; see FIGURES.

    Args:
        image: Rendered RGB [H, W, 3], uint8.
        depth: Rendered depth [H, W], metres, 0 = none.
        frame: What the camera saw there; its depth is the reference.
        seen: [H, W], not 0 where a training view saw what this view sees; None leaves these figures out.
        lpips: Networks to compare with.
        points: On the surface [N, 3] (m, world), which nothing was trained with.
    """
    reference, mask = frame.image, frame.mask
    row = {}
    masks = [("", mask)]
    if seen is not None:
        inside = (seen > 0) & (True if mask is None else mask > 0)
        row["seen_share"] = 100 * float(inside.sum() / max(seen.size if mask is None else (mask > 0).sum(), 1))
        masks.append(("seen_", inside))
    for prefix, where in masks:
        row[f"{prefix}psnr"] = metrics.psnr(image, reference, where)
        row[f"{prefix}psnr_gain"] = metrics.psnr(metrics.gain_fitted(image, reference, where), reference, where)
        row[f"{prefix}ssim"] = metrics.ssim(image, reference, where)
    for network in lpips:
        distances = network(image, reference, *(where for _, where in masks))
        row |= {f"{prefix}lpips_{network.backbone}": value for (prefix, _), value in zip(masks, distances)}
    if frame.depth is not None:
        judged = (frame.depth > 0) & (True if mask is None else mask > 0)
        row["depth_share"] = 100 * float((depth > 0)[judged].mean()) if judged.any() else np.nan
        row["depth_rmse"] = metrics.depth_rmse(depth, frame.depth, mask)
        scaled = metrics.median_scaled(depth, frame.depth, mask)
        row["depth_rmse_scaled"] = metrics.depth_rmse(scaled, frame.depth, mask)
        if seen is not None:
            row["seen_depth_rmse"] = metrics.depth_rmse(depth, frame.depth, masks[1][1])
    if points is not None:
        row["points_depth"] = metrics.depth_at_points(depth, *points_in_view(frame.camera, points), mask)
    if mask is not None and not mask.all():
        row["psnr_unmasked"], row["ssim_unmasked"] = metrics.psnr(image, reference), metrics.ssim(image, reference)
    return row


def mean_figures(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Mean of each figure over the views that have it."""
    found = {name: np.array([row[name] for row in rows if name in row]) for name in FIGURES}
    return {name: float(np.nanmean(values)) for name, values in found.items() if np.isfinite(values).any()}


def seen_pixels(camera: Camera, depth: np.ndarray, views: Sequence[tuple[Camera, np.ndarray, np.ndarray | None]]) -> np.ndarray:
    """Which pixels [H, W] of a view show a surface that one of the other views sees, too, and not hidden.

    Args:
        camera: The view.
        depth: Its depth [H, W], metres, 0 = none; a pixel without depth counts as not seen.
        views: Camera, depth [H, W] and mask [H, W] (0 = does not see) of the others.
    """
    points = camera.rays().astype(np.float32) * depth[..., None]
    seen = np.zeros(depth.shape, bool)
    for other, surface, mask in views:
        x, y, z = cv2.split(cv2.transform(points, (other.viewmat @ camera.pose)[:3]))
        ahead = np.where(z > 0, z, np.inf)
        # cv2 counts pixels from the centre of the first; outside the image there is no surface.
        u, v = x / ahead * other.K[0, 0] + (other.K[0, 2] - 0.5), y / ahead * other.K[1, 1] + (other.K[1, 2] - 0.5)
        shown = surface if mask is None else np.where(mask > 0, surface, 0)
        there = cv2.remap(shown.astype(np.float32), u.astype(np.float32), v.astype(np.float32), cv2.INTER_NEAREST, borderValue=0)
        seen |= (z > 0) & (there > 0) & (np.abs(z - there) < _SAME_SURFACE * there)
    return seen & (depth > 0)


def model_renderer(model: GaussianModel, device: str) -> DeformableRenderer:
    """Renders the model at rest, as large as the camera."""
    return DeformableRenderer(model, None, RenderingConfig(device=device, image_width=0))


def drawer(
    model: GaussianModel, motion: TissueMotion | None, drift: Drift, errors: CameraErrors, device: str
) -> Callable[[Frame, Camera | None], tuple[np.ndarray, np.ndarray]]:
    """Draws what a frame shows as it was recorded: an image [H, W, 3] and its depth [H, W].

    That is of its time, with its exposure, from where its camera is and through its lens. The second argument is the camera that carries
    the lamp, where that is another one.
    """
    moving = MovingModel(model, motion)

    def draw(frame: Frame, lamp: Camera | None) -> tuple[np.ndarray, np.ndarray]:
        renderer = model_renderer(moving.at(frame.stamp_ns), device)
        camera, lamp = errors.corrected(frame.camera, frame.stamp_ns), lamp and errors.corrected(lamp, frame.stamp_ns)
        drawn = renderer.render(camera, light=drift.at(model.light, frame.stamp_ns), lamp=lamp)
        return errors.lens.as_recorded(frame.camera, *drawn)

    return draw


def difference(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Absolute difference of RGB images, three times as strong; none where a mask [H, W] is 0."""
    result = np.abs(image.astype(int) - reference).clip(0, 85).astype(np.uint8) * 3
    return result if mask is None else np.where(mask[..., None] > 0, result, np.uint8(0))


def measure_held_out(trainer: Trainer, frames: Sequence[Frame] | Recording, out: Path) -> dict[str, float]:
    """Mean figures over frames that were not trained on; also logs them, and draws some of the frames.

    Args:
        trainer: Finished training; `reconstruct_bag` returns it with the frames.
        frames: Frames that were held out, one of which is in memory at a time; those that show no tissue do not count, which is told.
        out: Folder for held_out.png; a warning says so where it cannot be written.
    """
    draw = drawer(trainer.model, trainer.motion, trainer.drift, trainer.camera_errors, trainer.config.device)
    rows, pictures, left_out = [], [], Counter[str]()
    shown = {int(i) for i in np.linspace(0, len(frames) - 1, min(_STRIPS, len(frames)))}
    for index, frame in enumerate(frames):
        frame = shrink(frame, trainer.config.image_width)
        if reason := unusable(frame, trainer.config.views):
            left_out[reason] += 1
            continue
        image, depth = draw(frame, None)
        rows.append(measure(image, depth, frame))
        if index in shown:
            pictures += [
                (f"held-out view {index + 1} of {len(frames)}", frame.image),
                (f"rendered, {rows[-1]['psnr']:.1f} dB", image),
                ("difference × 3", difference(image, frame.image, frame.mask)),
                drawing.depth_panel(depth),
            ]
    for reason, count in left_out.items():
        log.warning("%s left out: %s", counted(count, "held-out view"), reason)
    if not rows:
        advice = "; --keyframes with a smaller number leaves some" if len(trainer.stamps) > 2 else ""
        log.info("no view was held out%s%s", " that shows tissue" if len(frames) else "", advice)
        (out / "held_out.png").unlink(missing_ok=True)  # of an earlier model
        return {}
    try:
        drawing.write_png(out / "held_out.png", drawing.sheet(pictures, columns=4))
    except OSError as error:  # the model is there, and so are its figures
        with contextlib.suppress(OSError):
            (out / "held_out.png").unlink(missing_ok=True)  # of an earlier model
        log.warning("%s; the model is kept", error)
    found = mean_figures(rows)
    for name, value in found.items():
        log.info("%-30s %.4g", FIGURES[name].title, value)
    return found | {"held_out_views": float(len(rows))}
