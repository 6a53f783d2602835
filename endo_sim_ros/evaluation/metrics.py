"""Image and depth quality as the field measures it."""

import cv2
import numpy as np


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio, dB, of images [H, W, 3] uint8 over the pixels where the mask [H, W] is not 0; NaN if there are none."""
    error = (image.astype(np.float64) - reference) ** 2
    if mask is not None:
        error = error[mask > 0]
    return float(10 * np.log10(255.0**2 / max(error.mean(), 1e-12))) if error.size else float("nan")


def gain_fitted(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """The image times the one gain per channel that fits the reference best, undoing a difference in exposure."""
    a, b = image.astype(np.float64), reference.astype(np.float64)
    if mask is not None:
        a, b = a[mask > 0], b[mask > 0]
    a, b = a.reshape(-1, 3), b.reshape(-1, 3)
    gain = (a * b).sum(0) / np.maximum((a * a).sum(0), 1e-12)
    return np.clip(image * gain, 0, 255)


def ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Mean structural similarity (11×11 Gaussian window, σ 1.5, mirrored borders) of images [H, W, 3] uint8.

    Pixels where the mask [H, W] is 0 are black in both images and not in the mean; NaN if that leaves none.
    """
    x, y = image.astype(np.float64) / 255, reference.astype(np.float64) / 255
    if mask is not None:
        x, y = x * (mask > 0)[..., None], y * (mask > 0)[..., None]
    blur = lambda a: cv2.GaussianBlur(a, (11, 11), 1.5, borderType=cv2.BORDER_REFLECT_101)
    mu_x, mu_y = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - mu_x**2, blur(y * y) - mu_y**2, blur(x * y) - mu_x * mu_y
    c1, c2 = 0.01**2, 0.03**2
    values = (2 * mu_x * mu_y + c1) * (2 * cov + c2) / ((mu_x**2 + mu_y**2 + c1) * (var_x + var_y + c2))
    if mask is not None:
        values = values[mask > 0]
    return float(values.mean()) if values.size else float("nan")


def depth_rmse(depth: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Root mean square depth error, metres, of [H, W] where both have a value (> 0)."""
    valid = (depth > 0) & (reference > 0) & (True if mask is None else mask > 0)
    return float(np.sqrt(((depth - reference)[valid].astype(np.float64) ** 2).mean())) if valid.any() else float("nan")


def depth_at_points(depth: np.ndarray, uv: np.ndarray, z: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Median difference, metres, of a depth [H, W] from that of points z [N] at pixels uv [N, 2] where it has a value (> 0).

    The median, since some points of structure from motion are wrong matches.
    """
    u, v = np.floor(uv).astype(int).T
    there = depth[v, u]
    valid = (there > 0) & (True if mask is None else mask[v, u] > 0)
    return float(np.median(np.abs(there - z)[valid])) if valid.any() else float("nan")


def median_scaled(depth: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """The depth [H, W] times the one factor that makes its median that of the reference, over the pixels that `depth_rmse` takes.

    Where the scale of the poses is arbitrary, only the error that is left then says something.
    """
    valid = (depth > 0) & (reference > 0) & (True if mask is None else mask > 0)
    return depth * (np.median(reference[valid]) / np.median(depth[valid])) if valid.any() else depth
