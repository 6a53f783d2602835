"""How near tissue is, told by its brightness: the lamp travels with the lens, so that what is near is bright."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.light import directions, falloff
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView, shrink
from endo_sim_ros.reconstruction.stage_configs import ExtrapolationConfig
from endo_sim_ros.reconstruction.triangulation import points_in_view

_WIDTH = 320  # pixels at which pictures are compared with points
_DARKEST = 4 / 255  # of a picture; below it is noise
_FLATTEST = 0.3  # exponent of the falloff with distance; with a smaller one brightness does not tell distance


class Lamp(NamedTuple):
    """How inverse depth follows `nearness`."""

    share: float  # of the squared differences of inverse depth from a plane in each view, how much it explains
    slope: float  # by how much inverse depth rises with it


def nearness(
    view: TrainingView, light: np.ndarray, exposure: np.ndarray, reference: float, options: ExtrapolationConfig = ExtrapolationConfig()
) -> np.ndarray:
    """Inverse depth [H, W] (1/m) at which tissue of colour 1 would be as bright in this light as the picture is; 0 outside tissue.

    Args:
        view: A training view.
        light, exposure: The light [4] and the logarithm of the view's exposure [3].
        reference: Distance (m) at which colours are the tissue's own.
        options: What is fine enough to be texture.
    """
    aside, tissue = directions(view.camera, "cpu"), (view.tissue > 0).astype(np.float32)
    brightness = (view.image / (255 * np.exp(exposure, dtype=np.float32))).mean(2).clip(_DARKEST)
    logarithm = np.log(brightness / falloff(aside, aside.new_tensor(light[1:])).numpy())
    blur = lambda values: cv2.GaussianBlur(values, (0, 0), options.texture * view.camera.width)
    blurred = blur(logarithm * tissue) / np.maximum(blur(tissue), 1e-6)
    # Depth is distance times the cosine.
    return tissue * np.exp(blurred / max(light[0], _FLATTEST) - aside[0].numpy()) / reference


def find_lamp(
    views: Sequence[TrainingView],
    points: np.ndarray,
    light: np.ndarray,
    exposures: np.ndarray,
    reference: float,
    options: ExtrapolationConfig = ExtrapolationConfig(),
    progress: StageProgress = StageProgress(),
) -> Lamp:
    """How inverse depth follows brightness in the views at points [N, 3] (m, world) on the tissue; other arguments as for `nearness`."""

    def compare(index: int) -> np.ndarray:
        view = shrink(views[index], _WIDTH)
        uv, z = points_in_view(view.camera, points, where=view.tissue > 0)
        if not len(z):
            return np.zeros(3)
        columns, rows = np.floor(uv).astype(int).T
        values = np.stack([nearness(view, light, exposures[index], reference, options)[rows, columns], 1 / z], 1)
        plane = np.column_stack([uv, np.ones(len(uv))])
        near, inverse = (values - plane @ np.linalg.lstsq(plane, values, rcond=None)[0]).T
        return np.array([(near * near).sum(), (near * inverse).sum(), (inverse * inverse).sum()])

    if light[0] < _FLATTEST:
        return Lamp(0.0, 0.0)
    squares, product, total = np.sum(progress.map(compare, range(len(views))), 0)
    if product <= 0:
        return Lamp(0.0, 0.0)
    return Lamp(product**2 / (squares * total), product / squares)
