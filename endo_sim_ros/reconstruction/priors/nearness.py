"""How near tissue is, told by its brightness: the lamp travels with the lens, so that what is near is bright."""

from collections.abc import Sequence

import cv2
import numpy as np

from endo_sim_ros.core.light import directions, falloff, features_at
from endo_sim_ros.reconstruction.scene import TrainingView

DARKEST = 4  # grey levels; below it is noise


def log_nearness(view: TrainingView, light: np.ndarray, exposure: np.ndarray, reference: float, blur: float) -> np.ndarray:
    """Logarithm of the inverse depth [H, W] (1/m) at which tissue of colour 1 would be as bright in this light as the picture is.

    Args:
        view: A training view; what is told outside its tissue means nothing.
        light, exposure: The light [4], whose brightness falls with distance, and the logarithm of the view's exposure [3].
        reference: Distance (m) at which colours are the tissue's own.
        blur: Standard deviation of the blur that takes texture from the picture, in its widths.
    """
    aside, tissue = directions(view.camera, "cpu"), (view.tissue > 0).astype(np.float32)
    logarithm = np.log(_grey(view) / (255 * falloff(aside, aside.new_tensor(light[1:])).numpy())) - exposure.mean()
    smooth = lambda values: cv2.GaussianBlur(values.astype(np.float32), (0, 0), blur * view.camera.width)
    blurred = smooth(logarithm * tissue) / np.maximum(smooth(tissue), 1e-6)
    return blurred / light[0] - aside[0].numpy() - np.log(reference)  # depth is distance times the cosine


def disagreements(
    view: TrainingView,
    depth: np.ndarray,
    where: np.ndarray,
    others: Sequence[tuple[TrainingView, np.ndarray]],
    light: np.ndarray,
    exposure: np.ndarray,
    reference: float,
) -> np.ndarray:
    """How much others see another colour where a view's pixels are, if they are as deep as given [M], as a difference of logarithms.

    Args:
        view, depth: A view and depths of its pixels [H, W], m.
        where: Which pixels [H, W] to compare.
        others: Other views and the logarithms of their exposures [3].
        light, exposure, reference: As for `log_nearness`.
    """
    points, own = view.camera.backproject(depth)[where], _grey(view)[where]
    found = [np.empty(0)]
    for other, its_exposure in others:
        uv, z = other.camera.project(points)
        index = np.flatnonzero(other.camera.contains(uv, z))
        columns, rows = np.floor(uv[index]).astype(int).T
        lit = other.tissue[rows, columns] > 0
        index, seen = index[lit], _grey(other)[rows[lit], columns[lit]]
        shaded = [features_at(points[index], camera, reference) @ light for camera in (view.camera, other.camera)]
        found.append(np.abs(np.log(own[index] / seen) - (shaded[0] - shaded[1]) - (exposure - its_exposure).mean()))
    return np.concatenate(found)


def _grey(view: TrainingView) -> np.ndarray:
    """The mean of the channels [H, W] without noise, grey levels."""
    return np.maximum(cv2.GaussianBlur(view.image, (0, 0), 1.0).mean(2), DARKEST)
