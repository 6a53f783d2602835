"""Where images show reflections of the light, not tissue."""

import cv2
import numpy as np

from endo_sim_ros.reconstruction.priors.inverse_depth import blur, scaled


def highlights(image: np.ndarray, tissue: np.ndarray, above: float) -> np.ndarray:
    """Mask [H, W] (bool) of where an image [H, W, 3] (uint8) shows reflections of the light, with the glow around them.

    Args:
        tissue: 1 where the image shows tissue, 0 elsewhere [H, W]; there are reflections on tissue alone.
        above: By how much all channels of a reflection are above what is around it, grey levels.
    """
    width = image.shape[1]
    least = np.minimum.reduce(cv2.split(image)).astype(np.float32)
    around = blur(least * tissue, 15, width) / np.maximum(blur(tissue, 15, width), 1e-3)
    bright = ((least > 250) | (least > around + above)) & (tissue > 0)  # white is a few levels short of 255
    return cv2.dilate(bright.astype(np.uint8), np.ones((2 * round(scaled(3, width)) + 1,) * 2, np.uint8)) > 0
