"""Which images masks belong to: raw or rectified ones, and of which number. The outlines of the tools tell."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.images import image_size
from endo_sim_ros.sequences.masks import read_mask
from endo_sim_ros.sequences.recording import spread

Reading = tuple[bool, int]  # whether masks belong to rectified images, and the number that the first frame has among them


class MaskAlignment:
    """Compares the outlines of masks with the edges of images under each reading of what the masks belong to.

    Args:
        files: Mask files by number.
        readings: What may be.
        frames: Frame numbers that there are images of.
        size: Width and height of the images, pixels.
        masks: Masks that are compared: those in which tools move most.
        looked_at: Masks that are read to find these.
        width: Largest width of the images that are compared, pixels; the tools' outlines are good to a pixel of it.
    """

    def __init__(
        self,
        files: Mapping[int, Path],
        readings: Sequence[Reading],
        frames: Sequence[int],
        size: tuple[int, int],
        *,
        masks: int = 16,
        looked_at: int = 64,
        width: int = 640,
    ):
        self._readings = readings
        inside = set(frames) if len(readings) > 1 else set()  # else there is nothing to find out
        usable = [n for n in sorted(files) if all(n - first in inside for _, first in readings)]
        self._files, self._size = files, size
        looked_at_first = spread(usable, looked_at)
        if looked_at_first:
            width = min(width, read_mask(files[looked_at_first[0]], size).shape[1])
        self._compared = width, round(width * size[1] / size[0])
        motion = {number: self._motion(number) for number in looked_at_first}
        telling = sorted((n for n, value in motion.items() if value is not None), key=lambda n: motion[n] or 0.0)[-masks:]
        self._outlines = {number: self._outline(number) for number in telling}
        self._fits: dict[int, dict[Reading, float]] = {number: {} for number in self._outlines}

    def _outline(self, number: int) -> np.ndarray:
        """Slope [H, W, 2] of a blurred mask: not zero along the outline of what is in it, and across it."""
        mask = cv2.resize(read_mask(self._files[number], self._size), self._compared, interpolation=cv2.INTER_AREA)
        return _slope(np.where(mask > 127, np.float32(1), np.float32(0)))

    def _motion(self, number: int) -> float | None:
        """How far the outline of a mask is from that of the next, relative to its length, 0 without a next; None where it is empty."""
        outline = self._outline(number)
        length = float(np.abs(outline).sum())
        if not length:
            return None
        return float(np.abs(outline - self._outline(number + 1)).sum()) / length if number + 1 in self._files else 0.0

    @property
    def frames(self) -> list[int]:
        """Numbers of the frames that `see` wants, in increasing order."""
        return sorted({number - first for number in self._outlines for _, first in self._readings})

    def see(self, number: int, raw: np.ndarray, rectified: np.ndarray) -> None:
        """Take note of a left image [H, W, 3], uint8, in both forms."""
        for image, is_rectified in ((raw, False), (rectified, True)):
            for reading in self._readings:
                mask = number + reading[1]
                if reading[0] == is_rectified and mask in self._outlines:
                    self._fits[mask][reading] = _fit(self._outlines[mask], image)

    def compare(
        self, one: Sequence[Reading], other: Sequence[Reading], *, least_masks: int = 3, least_gain: float = 0.05, least_share: float = 0.8
    ) -> tuple[bool | None, str]:
        """Whether the best of some readings fits better than the best of others, None where it cannot be told; and why, for people.

        Args:
            one, other: Readings.
            least_masks: Fewer masks tell nothing.
            least_gain: By what share outlines must lie on stronger edges; those of neighbouring frames differ by a tenth.
            least_share: Share of the masks that must say so.
        """
        fits = [
            [max(fit[reading] for reading in part) for part in (one, other)]
            for fit in self._fits.values()
            if len(fit) == len(self._readings)
        ]
        if len(fits) < least_masks:
            return None, f"outlines in {counted(len(fits), 'mask')} do not tell"
        gains = np.diff(np.log(np.maximum(fits, 1e-6)))[:, 0]
        better = bool(gains.mean() < 0)
        gain, share = float(np.expm1(np.abs(gains.mean()))), float(np.mean((gains < 0) == better))
        reason = f"edges along outlines of tools are {gain:.0%} stronger so, in {share:.0%} of {len(fits)} masks"
        return (better if gain > least_gain and share >= least_share else None), reason


def _slope(image: np.ndarray) -> np.ndarray:
    """Slope along x and y [..., 2] of a blurred image [H, W] or [H, W, C], float32."""
    soft = cv2.GaussianBlur(image, (0, 0), 1.0)
    return np.stack([cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)], -1)


def _fit(outline: np.ndarray, image: np.ndarray) -> float:
    """How strong the edges of an image are along an outline, relative to those anywhere."""
    size = image_size(outline)
    slope = _slope(cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32))
    across = np.abs((slope * outline[:, :, None]).sum(-1)).sum(-1)
    usual = np.linalg.norm(slope, axis=-1).sum(-1).mean() * np.linalg.norm(outline, axis=-1).sum()
    return float(across.sum() / max(usual, 1e-9))
