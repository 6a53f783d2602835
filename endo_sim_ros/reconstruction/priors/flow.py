"""What the optical flow between an image and its prediction from another one tells of depth."""

from typing import Any, NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.priors.inverse_depth import blur, scaled
from endo_sim_ros.reconstruction.stage_configs import MultiViewConfig


class EyeImage(NamedTuple):
    """What one eye of a view sees, freed of what differs between images of the same tissue."""

    camera: Camera
    grey: np.ndarray  # [H, W] uint8, freed of light and contrast
    bits: np.ndarray  # [H, ⌈W / 8⌉] uint8, the matte in an eighth of its memory, as images of all views are kept

    @property
    def matte(self) -> np.ndarray:
        """Tissue without reflections of the light [H, W], uint8, 1 or 0."""
        return np.unpackbits(self.bits, 1, count=self.camera.width)

    def with_matte(self, matte: np.ndarray) -> "EyeImage":
        """The same with another matte [H, W], 0 where it does not count."""
        return self._replace(bits=np.packbits(matte > 0, 1))


class FlowCorrection(NamedTuple):
    """What another image tells of a view's depth."""

    correction: np.ndarray  # [H, W] 1/m, of inverse depth
    precision: np.ndarray  # [H, W] m², 0 where it tells nothing


def eye_image(frame: Frame, options: MultiViewConfig) -> EyeImage:
    """The image of a frame, for `flow_correction`."""
    tissue, width = frame.tissue, frame.camera.width
    grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    around = lambda values: blur(values, options.contrast_window, width)
    share = np.maximum(around(tissue), 1e-3)
    mean = around(grey * tissue) / share
    variance = np.maximum(around(grey * grey * tissue) / share - mean * mean, 0)
    grey = np.clip(128 + 40 * (grey - mean) / np.sqrt(variance + 4), 0, 255).astype(np.uint8)  # 2 grey levels are noise
    return EyeImage(frame.camera, grey, np.packbits((tissue > 0) & ~_reflections(frame.image, tissue, options), 1))


def _reflections(image: np.ndarray, tissue: np.ndarray, options: MultiViewConfig) -> np.ndarray:
    """Where an image [H, W, 3] shows reflections of the light [H, W], which lie deeper than the tissue [H, W] and move with the camera."""
    width = image.shape[1]
    least = image.min(2).astype(np.float32)
    around = blur(least * tissue, 15, width) / np.maximum(blur(tissue, 15, width), 1e-3)
    bright = ((least > 250) | (least > around + options.reflection)) & (tissue > 0)  # white is a few levels short of 255
    return cv2.dilate(bright.astype(np.uint8), np.ones((2 * round(scaled(3, width)) + 1,) * 2, np.uint8)) > 0  # with the glow around


def flow_correction(inverse: np.ndarray, own: EyeImage, other: EyeImage, options: MultiViewConfig) -> FlowCorrection | None:
    """What another image tells of a view's inverse depth [H, W] (1/m); None where nothing can tell.

    The view's image is predicted from the other with its depth. Flow between prediction and image, along the direction in which depth
    moves a pixel, is a correction of inverse depth; across it, it is from poses, calibration or motion.
    """
    camera = own.camera
    unit = camera.width / 640
    u, v, z = _project(camera, inverse, other.camera)
    inside = (z > 0) & (_sample(other.matte, u, v, cv2.INTER_NEAREST) > 0)
    if not inside.any() or min(inside.shape) < 16:  # pixels, which optical flow needs
        return None
    step = 0.01 * inverse
    ahead = _project(camera, inverse + step, other.camera)
    along_u, along_v = ((there - here) / step for there, here in zip(ahead, (u, v)))
    del z, ahead  # each image of numbers takes as much memory as two of colours
    columns, rows, good = _led_to(own.grey, np.where(inside, _sample(other.grey, u, v), own.grey), unit, options)
    good &= inside & (own.matte > 0) & (_sample(inside.astype(np.float32), columns, rows, cv2.INTER_NEAREST) > 0)
    seen_u, seen_v = _sample(u, columns, rows), _sample(v, columns, rows)
    alike = _correlation(own.grey, _sample(other.grey, seen_u, seen_v))
    off_u, off_v = seen_u - u, seen_v - v
    speed = np.maximum(along_u**2 + along_v**2, 1e-9)  # squared pixels per 1/m
    beside = np.abs(along_u * off_v - along_v * off_u) / np.sqrt(speed)
    good &= (beside < options.max_beside * unit) & (np.hypot(off_u, off_v) < options.max_flow * unit)
    if not good.any():
        return None
    # Across the line no depth tells anything: what is off there is what poses, calibration and flow are off along it, too.
    error = options.flow_error * max(1.4826 * float(np.median(beside[good])), 0.01)
    precision = np.where(good, speed * (alike / error) ** 2, 0)
    return FlowCorrection((along_u * off_u + along_v * off_v) / speed, precision)


def _led_to(image: np.ndarray, predicted: np.ndarray, unit: float, options: MultiViewConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows [H, W] that optical flow leads to from an image to its prediction, and whether it can be believed [H, W]."""
    # The way back, a mere check, is told in images of half the size: a fifth of all the time, and a hundredth of the precision.
    flow, back = _flow(image, predicted), _flow(predicted, image, finest=1)
    height, width = image.shape
    columns = np.arange(width, dtype=np.float32) + np.float32(0.5) + flow[..., 0]
    rows = np.arange(height, dtype=np.float32)[:, None] + np.float32(0.5) + flow[..., 1]
    returns = np.hypot(*cv2.split(flow + _sample(back, columns, rows))) < options.max_round_trip
    return columns, rows, returns & (np.abs(flow).max(2) < options.max_flow * unit)


def _flow(image: np.ndarray, other: np.ndarray, finest: int = 0) -> np.ndarray:
    """By how many pixels [H, W, 2] what an image shows lies elsewhere in another; ``finest`` halvings of the images are left out."""
    flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    flow.setFinestScale(finest)
    return flow.calc(image, other, None)


def _project(camera: Camera, inverse: np.ndarray, other: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where another camera sees a view's pixels of the given inverse depth: u, v and z [H, W] float32."""
    motion = (other.viewmat @ camera.pose)[:3]
    # Scaled by inverse depth, which leaves u and v alone, z keeps its sign.
    turned = cv2.split(cv2.transform(camera.rays().astype(np.float32), motion[:, :3]))
    x, y, z = (part + (inverse * shift).astype(np.float32) for part, shift in zip(turned, motion[:, 3:]))
    ahead = np.where(z > 1e-3, z, np.inf)
    K = other.K
    far = np.float32(-1e4)  # out of any picture
    u, v = (np.where(z > 1e-3, a / ahead * f + c, far) for a, f, c in ((x, K[0, 0], K[0, 2]), (y, K[1, 1], K[1, 2])))
    return u.astype(np.float32), v.astype(np.float32), z


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Values of an image at pixels u, v [H, W]; 0 beyond it."""
    half = np.float32(0.5)  # OpenCV counts from the centre of the first pixel
    return cv2.remap(image, u - half, v - half, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Correlation [H, W] of two images over windows of 11 × 11 pixels, none below 0."""
    a, b = a.astype(np.float32), b.astype(np.float32)
    mean = lambda values: cv2.blur(values, (11, 11))
    ma, mb = mean(a), mean(b)
    spread = np.maximum((mean(a * a) - ma * ma) * (mean(b * b) - mb * mb), 1e-3)
    return np.clip((mean(a * b) - ma * mb) / np.sqrt(spread), 0, 1)
