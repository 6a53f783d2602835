"""Depth priors corrected by other images of the same tissue: the right one of the same view, and other views.

The lenses of a stereo endoscope are millimetres apart, its views centimetres: by how many pixels tissue in one view
lies beside where another view's depth and pose expect it tells that depth several times better than the pair of lenses.
"""

import dataclasses
from typing import NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import map_in_threads
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.photometry import reflections
from endo_sim_ros.reconstruction.priors.sources import MATCHED, right_view
from endo_sim_ros.reconstruction.triangulation import ScenePoints, neighbours

_NEIGHBOURS = 4  # views that each view is compared with: the nearest in space
_LEAST_SIDE = 16  # pixels, of images that optical flow can be found in
_LEAST_SHARED = 0.05  # of the picture, below which two views are not compared
_REMATCHED = 0.15  # pixels, error of a disparity that flow between the eyes has corrected
_OF_POINTS, _GUESSED = 0.015, 0.05  # relative error of depth between scene points, and of that of which none is known
_FLOW = 0.35  # pixels, error of a displacement, that of the poses included
_NOT_BACK = 0.4  # pixels by which flow there and flow back may miss each other; they do where one image shows what the other hides
_EYES = 0.6  # share of it between the eyes of one view
_ALIKE = 0.5  # correlation from which on two pixels show the same tissue
_LEAST_SEEN = 0.02  # share of the pixels with depth
_DOUBTED = 3.0  # errors of the prior by which a scene point may contradict it before it counts half
_TOO_FAR = 0.25  # relative difference from which on a point lies on another surface
# In pixels of an image 640 wide:
_STEP = 1.0  # farthest that matching with the right image is believed to be off
# Over how much depth is smoothed within edges (standard deviation), and how large a relative step is one: as matched, as corrected
# between the eyes, and in the end. Of what is known better, smaller steps are edges.
_MATCHED, _BY_EYES, _IN_THE_END = (24.0, 0.1), (10.0, 0.03), (10.0, 0.02)
_FINELY = 8.0  # pixels, standard deviation up to which the filter takes all pixels
_OFF_LINE = 2.0  # farthest beside the line on which depth alone can move a point
_FARTHEST = 40.0  # longest displacement that optical flow is believed
_LOCAL = 8.0  # standard deviation of the window that brightness is compared to
_WINDOW = 9  # side of the window of the correlation
_REACH = 11  # side of the square that a scene point speaks for
_SMOOTH = 12.0  # standard deviation over which corrections are carried to pixels without


class _Image(NamedTuple):
    """What one eye of a view sees."""

    camera: Camera
    plain: np.ndarray  # grey [H, W] uint8, freed of light and contrast
    tissue: np.ndarray  # [H, W] float32, 1 = there
    matte: np.ndarray  # the same without reflections of the light


def agreed(frames: list[Frame], points: ScenePoints, source: str) -> tuple[list[Frame], float]:
    """The frames with depth corrected, in their holes as little as before, by scene points and by what neighbouring views show,
    and by how many pixels the views contradict each other all the same.

    A view's image is predicted from each neighbour's with the view's depth; the optical flow between prediction and
    image, along the direction in which depth moves a pixel, is a correction of inverse depth that is the more precise the
    farther apart the views are. Corrections and prior are averaged by their precision; where there is none, that of
    the surroundings counts; what ripples are left within edges is smoothed. Before it, the prior of matching with a view's
    right image is corrected likewise by that image. Reflections of the light count between the eyes alone. What flow is
    left across that direction no depth explains: it is from poses, calibration or motion; its median is returned (pixels),
    NaN where no two views show the same.

    Args:
        frames: Views with a depth prior.
        points: Scene points.
        source: Where the prior is from, as `depth_source` tells, on which its error depends.
    """
    images = [_seen(frame) for frame in frames]
    near = neighbours(frames, _NEIGHBOURS)

    def corrected(i: int) -> tuple[Frame, list[tuple[float, float]]]:
        frame, camera, contradictions = frames[i], frames[i].camera, []
        if frame.depth is None or (frame.depth > 0).mean() < _LEAST_SEEN:
            return frame, []
        known = frame.depth > 0
        inverse = _filled((known / np.where(known, frame.depth, 1)).astype(np.float32)[..., None], known)[..., 0]
        error = (_OF_POINTS if source == "points" else _GUESSED) * inverse
        if source == "stereo" and frame.right is not None:
            inverse, error = _rematched(inverse, images[i], _seen(right_view(frame)), camera.K[0, 0] * frame.baseline)
        total, weight = _of_points(frame, inverse, error, points)
        for j in near[i]:
            if j != i:
                found = _of_image(inverse, images[i], images[j])
                if found is not None:
                    correction, precision, *contradiction = found
                    total, weight = total + precision * correction, weight + precision
                    contradictions.append(contradiction)
        inverse = _corrected(inverse, total, weight, error, camera.width, _IN_THE_END)
        good = known & np.isfinite(inverse) & (inverse > 0)
        depth = np.where(good, 1 / np.where(good, inverse, 1), 0).astype(np.float32)
        return dataclasses.replace(frame, depth=depth), contradictions

    results = map_in_threads(corrected, range(len(frames)))
    off, shares = np.array([pair for _, pairs in results for pair in pairs]).reshape(-1, 2).T
    return [frame for frame, _ in results], float((off * shares).sum() / shares.sum()) if shares.sum() else float("nan")


def _rematched(inverse: np.ndarray, left: _Image, right: _Image, pixel: float) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth [H, W] (1/m) of matching, corrected by the flow that it leaves between the eyes, and its error [H, W].

    Semi-global matching prefers whole pixels and goes in steps; optical flow does neither, but errs wildly where there is little to see.
    """
    width, matched = left.camera.width, np.full(inverse.shape, MATCHED / pixel, np.float32)
    inverse = _smooth(inverse, width, _MATCHED)
    # Between the eyes reflections hardly move.
    found = _of_image(inverse, left._replace(matte=left.tissue), right._replace(matte=right.tissue))
    if found is None:
        return inverse, matched
    correction, precision, *_ = found
    precision = np.where(np.abs(correction) * pixel < _STEP * width / 640, precision / _EYES**2, 0)
    correction = np.where(precision > 0, correction, 0)
    rematched = _corrected(inverse, precision * correction, precision, matched, width, _BY_EYES)
    # Where flow tells nothing, far and wide, the error stays that of matching.
    told = cv2.GaussianBlur((precision > 0).astype(np.float32), (0, 0), _SMOOTH * width / 640)
    error = (MATCHED + (_REMATCHED - MATCHED) * np.minimum(2 * told, 1)) / pixel
    return rematched, error


def _corrected(
    inverse: np.ndarray, total: np.ndarray, weight: np.ndarray, error: np.ndarray | float, width: int, ripples: tuple[float, float]
) -> np.ndarray:
    """Inverse depth [H, W] of the given error with corrections, of which Σ precision × correction and Σ precision are given.

    Where there are none, those of the surroundings count; nothing moves to another surface; ripples within edges are smoothed.
    """
    correction, trust = total / np.maximum(weight, 1e-12), weight / (weight + 1 / error**2)
    blur = lambda values: cv2.GaussianBlur(values.astype(np.float32), (0, 0), _SMOOTH * width / 640)
    around = blur(trust)
    carried = blur(trust * correction) / np.maximum(around, 1e-6) * np.minimum(4 * around, 1)
    added = np.clip(trust * correction + (1 - trust) * carried, -_TOO_FAR * inverse, _TOO_FAR * inverse)
    return _smooth(inverse + added, width, ripples)


def _smooth(inverse: np.ndarray, width: int, ripples: tuple[float, float]) -> np.ndarray:
    """Inverse depth [H, W] without ripples of so many pixels (in an image 640 wide), relative steps of such a size kept."""
    relative = (inverse / np.float32(np.median(inverse))).astype(np.float32)
    spread, edge = ripples[0] * width / 640, ripples[1]
    smooth, stride = np.empty_like(relative), max(round(spread / _FINELY), 1)
    # The filter takes as long as its window is large: of large ones every n-th pixel is filtered with others of its kind.
    for row, column in np.ndindex(min(stride, len(relative)), stride):
        part = np.ascontiguousarray(relative[row::stride, column::stride])
        smooth[row::stride, column::stride] = cv2.bilateralFilter(part, 0, edge, spread / stride)
    return np.float32(np.median(inverse)) * smooth


def _seen(frame: Frame) -> _Image:
    tissue = frame.tissue
    return _Image(frame.camera, _plain(frame, tissue), tissue, tissue * ~reflections(frame.image, tissue))


def _plain(frame: Frame, tissue: np.ndarray) -> np.ndarray:
    """Grey image [H, W] uint8, where there is tissue [H, W], freed of light and contrast, which differ between views."""
    grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    blur = lambda values: cv2.GaussianBlur(values, (0, 0), _LOCAL * frame.camera.width / 640)
    share = np.maximum(blur(tissue), 1e-3)
    mean = blur(grey * tissue) / share
    variance = np.maximum(blur(grey * grey * tissue) / share - mean * mean, 0)
    return np.uint8(np.clip(128 + 40 * (grey - mean) / np.sqrt(variance + 4), 0, 255))


def _of_points(frame: Frame, inverse: np.ndarray, error: np.ndarray, points: ScenePoints) -> tuple[np.ndarray, np.ndarray]:
    """Σ precision × correction and Σ precision [H, W] of inverse depth [H, W] (1/m) of an error [H, W] by the scene points around.

    Some points are wrong, more than their own error tells: they count the less (Cauchy) the more their depth and the prior disagree.
    """
    total, weight = np.zeros(inverse.shape, np.float32), np.zeros(inverse.shape, np.float32)
    if len(points.positions):
        uv, z = frame.camera.project(points.positions)
        inside = (z > 0) & (uv >= 0).all(1) & (uv < inverse.shape[::-1]).all(1)
        u, v = np.floor(uv[inside]).astype(int).T
        there = inverse[v, u]
        correction = 1 / z[inside] - there
        near = np.abs(correction) < _TOO_FAR * there
        u, v, there, correction = u[near], v[near], there[near], correction[near]
        precision = 1 / (np.broadcast_to(points.error, z.shape)[inside][near] * there) ** 2
        precision /= 1 + (correction / (_DOUBTED * error[v, u])) ** 2
        np.add.at(total, (v, u), precision * correction)
        np.add.at(weight, (v, u), precision)
        side = 2 * round(_REACH * frame.camera.width / 1280) + 1
        total, weight = (cv2.boxFilter(array, -1, (side, side), normalize=False) for array in (total, weight))
    return total, weight


def _of_image(inverse: np.ndarray, own: _Image, other: _Image) -> tuple[np.ndarray, np.ndarray, float, float] | None:
    """Correction (1/m) of a view's inverse depth [H, W] by another image, and its precision (m²), 0 where it tells nothing.

    Also the median of what no depth explains (pixels), and the share of the picture that it is of; None where nothing can tell.
    """
    camera = own.camera
    unit = camera.width / 640
    u, v, z = _projected(camera, inverse, other.camera)
    inside = (z > 0) & (_sampled(other.matte, u, v, cv2.INTER_NEAREST) > 0)
    if inside.mean() < _LEAST_SHARED or min(inside.shape) < _LEAST_SIDE:
        return None
    predicted = np.where(inside, _sampled(other.plain, u, v), own.plain)
    flow, back = _flow(own.plain, predicted), _flow(predicted, own.plain)
    # A pixel is seen where the prediction took the pixel from that flow leads to.
    rows, columns = np.mgrid[: inverse.shape[0], : inverse.shape[1]].astype(np.float32) + np.float32(0.5)
    columns, rows = columns + flow[..., 0], rows + flow[..., 1]
    seen_u, seen_v = _sampled(u, columns, rows), _sampled(v, columns, rows)
    step = 0.01 * inverse
    ahead_u, ahead_v, _ = _projected(camera, inverse + step, other.camera)
    along_u, along_v = (ahead_u - u) / step, (ahead_v - v) / step
    speed = np.maximum(along_u**2 + along_v**2, 1e-9)  # squared pixels per 1/m
    off_u, off_v = seen_u - u, seen_v - v
    beside = np.abs(along_u * off_v - along_v * off_u) / np.sqrt(speed)
    alike = _correlation(own.plain, _sampled(other.plain, seen_u, seen_v), _WINDOW)
    good = inside & (_sampled(np.float32(inside), columns, rows, cv2.INTER_NEAREST) > 0) & (own.matte > 0) & (alike > _ALIKE)
    contradiction = float(np.median(beside[good])) if good.any() else 0.0, float(good.mean())
    good &= (beside < _OFF_LINE * unit) & (np.abs(flow).max(2) < _FARTHEST * unit)
    good &= np.hypot(off_u, off_v) < _FARTHEST * unit
    good &= np.hypot(*cv2.split(flow + _sampled(back, columns, rows))) < _NOT_BACK
    return (along_u * off_u + along_v * off_v) / speed, np.where(good, speed * (alike / _FLOW) ** 2, 0), *contradiction


def _flow(image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """By how many pixels [H, W, 2] what an image shows lies elsewhere in another."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(0)
    return flow.calc(image, other, None)


def _projected(camera: Camera, inverse: np.ndarray, other: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where another camera sees a view's pixels of the given inverse depth: u, v and z [H, W] float32."""
    motion = (other.viewmat @ camera.pose)[:3]
    # Scaled by inverse depth, which leaves u and v alone, z keeps its sign.
    rays = camera.rays().astype(np.float32)
    x, y, z = cv2.split(cv2.transform(rays, motion[:, :3]) + (inverse[..., None] * motion[:, 3]).astype(np.float32))
    ahead = np.where(z > 1e-3, z, np.inf)
    K = other.K
    far = np.float32(-1e4)
    u, v = (np.where(z > 1e-3, a / ahead * f + c, far) for a, f, c in ((x, K[0, 0], K[0, 2]), (y, K[1, 1], K[1, 2])))
    return u.astype(np.float32), v.astype(np.float32), z


def _sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    half = np.float32(0.5)  # cv2 counts from the centre of the first pixel
    return cv2.remap(image, u - half, v - half, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def _correlation(a: np.ndarray, b: np.ndarray, side: int) -> np.ndarray:
    """Correlation [H, W] of two images over a window."""
    a, b = a.astype(np.float32), b.astype(np.float32)
    mean = lambda values: cv2.blur(values, (side, side))
    ma, mb = mean(a), mean(b)
    spread = np.maximum((mean(a * a) - ma * ma) * (mean(b * b) - mb * mb), 1e-3)
    return np.clip((mean(a * b) - ma * mb) / np.sqrt(spread), 0, 1)


def _filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values [H, W, C] where known [H, W]; elsewhere the mean over ever wider surroundings (pull-push)."""
    weight = known.astype(np.float32)
    levels = [(weight, values.astype(np.float32) * weight[..., None])]
    while min(levels[-1][0].shape) > 1:
        weight, total = (_halved(array) for array in levels[-1])
        scale = np.maximum(weight, 1)
        levels.append((weight / scale, total / scale[..., None]))
    weight, total = levels[-1]
    mean = sum(t.reshape(-1, t.shape[-1]).sum(0) for _, t in levels[-1:]) / max(float(weight.sum()), 1e-6)
    whole = total + (1 - weight)[..., None] * mean
    for weight, total in levels[-2::-1]:
        coarse = cv2.resize(whole, weight.shape[::-1], interpolation=cv2.INTER_LINEAR).reshape(total.shape)
        whole = total + (1 - weight)[..., None] * coarse
    return whole


def _halved(array: np.ndarray) -> np.ndarray:
    """Sums of 2 × 2 pixels; an odd row or column is alone."""
    rows, columns = array.shape[:2]
    padded = np.pad(array, ((0, rows % 2), (0, columns % 2), *[(0, 0)] * (array.ndim - 2)))
    return padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]
