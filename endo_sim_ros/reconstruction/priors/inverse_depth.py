"""Images of inverse depth, corrected and smoothed within edges.

Sizes of windows are given in pixels of an image 640 wide. `scaled` converts them to the width of the image at hand.
"""

import cv2
import numpy as np
import torch

from endo_sim_ros.core.kernels import launch, load_kernels
from endo_sim_ros.reconstruction.priors import smoothing_kernels


def scaled(size: float, width: int) -> float:
    """A size in pixels of an image of this width, from one in pixels of an image 640 wide."""
    return size * width / 640


def blur(values: np.ndarray, size: float, width: int) -> np.ndarray:
    """The values [H, W], of an image of this width, blurred by a Gaussian. Its standard deviation ``size`` is for an image 640 wide."""
    return cv2.GaussianBlur(values.astype(np.float32), (0, 0), scaled(size, width))


def correct(inverse: np.ndarray, total: np.ndarray, weight: np.ndarray, error: np.ndarray, reach: float, limit: float) -> np.ndarray:
    """Inverse depth [H, W] (1/m) plus corrections, which are weighed by their precision and continued to pixels that have none.

    Args:
        inverse, error: Inverse depth [H, W] and its standard deviation [H, W], 1/m.
        total, weight: Σ precision × correction and Σ precision [H, W] of the corrections.
        reach: Standard deviation of the surroundings, pixels of an image 640 wide.
        limit: Largest relative correction: nothing moves to another surface.
    """
    correction, trust = total / np.maximum(weight, 1e-12), weight / (weight + 1 / error**2)
    width = inverse.shape[1]
    around = blur(trust, reach, width)
    continued = blur(trust * correction, reach, width) / np.maximum(around, 1e-6) * np.minimum(4 * around, 1)
    return inverse + np.clip(trust * correction + (1 - trust) * continued, -limit * inverse, limit * inverse)


def prepare_smoothing(device: str) -> None:
    """Load what `smooth` needs on a device, before several threads smooth."""
    if device != "cpu":
        load_kernels((smoothing_kernels,), device)


def smooth(inverse: np.ndarray, size: float, edge: float, device: str = "cpu") -> np.ndarray:
    """Inverse depth [H, W] (1/m) without ripples.

    Ripples up to ``size`` (standard deviation, pixels of an image 640 wide) are removed; relative steps above ``edge`` stay. On a GPU
    it takes a hundredth of the time that OpenCV does.
    """
    median = np.float32(np.median(inverse))
    relative = (inverse / median).astype(np.float32)
    spread = scaled(size, inverse.shape[1])
    # The filter takes as long as its window is large: beyond 8 pixels every n-th pixel is filtered with others of its kind.
    smoothed, stride = np.empty_like(relative), max(round(spread / 8), 1)
    if device != "cpu":
        given, found = torch.from_numpy(relative).to(device), torch.empty(relative.shape, device=device)
        radius = max(round(1.5 * spread / stride), 1)  # as that of OpenCV's filter
        launch(smoothing_kernels.bilateral, relative.size, [given, edge, spread / stride, radius, stride, found], device)
        return median * found.cpu().numpy()
    for row, column in np.ndindex(min(stride, len(relative)), stride):
        part = np.ascontiguousarray(relative[row::stride, column::stride])
        smoothed[row::stride, column::stride] = cv2.bilateralFilter(part, 0, edge, spread / stride)
    return median * smoothed
