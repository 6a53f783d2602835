"""How near tissue is, told by its brightness: the lamp travels with the lens, so that what is near is bright."""

from collections.abc import Sequence

import cv2
import numpy as np

from endo_sim_ros.core.light import directions, falloff, features_at, untoned
from endo_sim_ros.reconstruction.scene import TrainingView

_DARKEST = 4 / 255  # of white; below it is noise


def log_nearness(view: TrainingView, light: np.ndarray, exposure: np.ndarray, reference: float, blur: float) -> np.ndarray:
    """Logarithm of the inverse depth [H, W] (1/m) at which tissue of colour 1 would be as bright in this light as the picture is.

    Args:
        view: A training view; what is told outside its tissue means nothing.
        light, exposure: The light [4], whose brightness falls with distance, and the logarithm of the view's exposure [3].
        reference: Distance (m) at which colours are the tissue's own.
        blur: Standard deviation of the blur that takes texture from the picture, in its widths.
    """
    aside, tissue = directions(view.camera, "cpu"), (view.tissue > 0).astype(np.float32)
    logarithm = np.log(_grey(view) / falloff(aside, aside.new_tensor(light[1:])).numpy()) - exposure.mean()
    smooth = lambda values: cv2.GaussianBlur(values.astype(np.float32), (0, 0), blur * view.camera.width)
    blurred = smooth(logarithm * tissue) / np.maximum(smooth(tissue), 1e-6)
    return blurred / light[0] - aside[0].numpy() - np.log(reference)  # depth is distance times the cosine


def disagreements(
    view: TrainingView,
    depths: Sequence[np.ndarray],
    where: np.ndarray,
    others: Sequence[tuple[TrainingView, np.ndarray]],
    light: np.ndarray,
    exposure: np.ndarray,
    reference: float,
) -> np.ndarray:
    """How much another colour other views see where a view's pixels would be, for each of several depths [M, K]: differences of
    logarithms, where another sees tissue with all of the depths.

    Args:
        view: Whose pixels.
        depths: K candidates [H, W], m.
        where: Which pixels [H, W] to compare.
        others: Other views and the logarithms of their exposures [3].
        light, exposure, reference: As for `log_nearness`.
    """
    clouds, own = [view.camera.backproject(depth)[where] for depth in depths], _grey(view)[where]
    found = [np.empty((0, len(depths)))]
    for other, its_exposure in others:
        pixels = [other.camera.project(points) for points in clouds]
        index = np.flatnonzero(np.all([other.camera.contains(*each) for each in pixels], 0))
        places = [np.floor(uv[index]).astype(int)[:, ::-1] for uv, _ in pixels]
        lit = np.all([other.tissue[tuple(place.T)] > 0 for place in places], 0)
        index, grey, changed = index[lit], _grey(other), (exposure - its_exposure).mean()
        columns = []
        for points, place in zip(clouds, places):
            here, there = (features_at(points[index], camera, reference) @ light for camera in (view.camera, other.camera))
            columns.append(np.abs(np.log(own[index] / grey[tuple(place[lit].T)]) - (here - there) - changed))
        found.append(np.stack(columns, 1))
    return np.concatenate(found)


def _grey(view: TrainingView) -> np.ndarray:
    """The mean brightness of the channels [H, W] without noise."""
    smooth = cv2.GaussianBlur(view.image, (0, 0), 1.0) / np.float32(255)
    return np.maximum(untoned(smooth, view.shoulder).mean(2), _DARKEST)
