"""By how much recorded cameras are off, in their poses and in their lens; and cameras and pictures without that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera, invert_pose, rigid_pose
from endo_sim_ros.core.frames import Frame, interpolated

_LEAST_DIVISOR = 0.05  # of slopes; what is distorted by more is seen by no lens
_OUTSIDE = -2.0  # pixels, of no picture


@dataclass(frozen=True)
class LensError:
    """What a lens does that the pinhole camera of its recording does not; the same in all its pictures.

    Distortion is that of the division model (Fitzgibbon, CVPR 2001): a ray of slope s, one of a straight picture, is seen at the slope d
    with s = d / (1 + division |d|²). Barrels have divisions below 0.

    Args:
        focal: How many times as long as recorded the focal length is, in pixels across.
        division: Coefficient of the distortion.
        aspect: How many times as long, to that, the focal length is in pixels down.
        right, down: How far the principal point is beside the recorded one, in recorded focal lengths.
    """

    focal: float = 1.0
    division: float = 0.0
    aspect: float = 1.0
    right: float = 0.0
    down: float = 0.0

    def rays(self, slopes: np.ndarray) -> np.ndarray:
        """Slopes of rays [..., 2] of what the camera as recorded has at slopes [..., 2]."""
        return (slopes - self._middle) / self.magnified(slopes)

    def magnified(self, slopes: np.ndarray) -> np.ndarray:
        """How many times as steep as their rays [..., 2] slopes [..., 2] are that the camera as recorded has there."""
        return self._focal * np.maximum(1 + self.division * (self._seen(slopes) ** 2).sum(-1, keepdims=True), _LEAST_DIVISOR)

    @property
    def _focal(self) -> np.ndarray:
        return self.focal * np.array([1.0, self.aspect])

    @property
    def _middle(self) -> np.ndarray:
        return np.array([self.right, self.down])

    def _seen(self, slopes: np.ndarray) -> np.ndarray:
        """Slopes [..., 2] at which the lens shows what the camera as recorded has at slopes [..., 2]."""
        return (slopes - self._middle) / self._focal

    def camera(self, recorded: Camera) -> Camera:
        """The pinhole camera of a straight picture, which shows all of the recorded one and is as large."""
        return replace(recorded, K=self._straight(recorded.K, self._enlargement(recorded)))

    def _straight(self, K: np.ndarray, times: float) -> np.ndarray:
        """Intrinsics [3, 3] of a straight picture, whose focal length is so many times as long as recorded, of those that are recorded."""
        straight = K * np.array([[times, 1, 1], [1, times * self.aspect, 1], [1, 1, 1]])
        straight[:2, 2] += self._middle * K.diagonal()[:2]
        return straight

    def straight(self, frame: Frame) -> Frame:
        """A frame as this camera sees it; its mask leaves out what is beyond the recorded picture."""
        times, camera = self._enlargement(frame.camera), self.camera(frame.camera)
        right_K = None if frame.right_K is None else self._straight(frame.right_K, times)
        if not self.division:
            return replace(frame, camera=camera, right_K=right_K)
        maps = self._maps(frame.camera, frame.camera.K, times)
        mask = np.full(frame.image.shape[:2], 255, np.uint8) if frame.mask is None else frame.mask
        image = cv2.remap(frame.image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)  # else its border would be dark
        moved = {"image": image, "mask": cv2.remap(mask, *maps, cv2.INTER_NEAREST)}
        if frame.depth is not None:  # along the optical axis, it is the same
            moved["depth"] = cv2.remap(frame.depth, *maps, cv2.INTER_NEAREST)
        if frame.right is not None:
            moved["right"] = cv2.remap(frame.right, *self._maps(frame.camera, frame.right_intrinsics, times), cv2.INTER_CUBIC)
        return replace(frame, camera=camera, right_K=right_K, **moved)

    def as_recorded(self, recorded: Camera, image: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A straight picture [H, W, 3] and its depth [H, W] as the recorded camera would have them."""
        if not self.division:
            return image, depth
        K = self.camera(recorded).K
        at = (self.rays(recorded.rays()[..., :2]) * K.diagonal()[:2] + K[:2, 2] - 0.5).astype(np.float32)
        maps = at[..., 0], at[..., 1]
        return cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), cv2.remap(depth, *maps, cv2.INTER_NEAREST)

    def _enlargement(self, recorded: Camera) -> float:
        """How many times as long as recorded the focal length of the straight picture is."""
        if not self.division:
            return self.focal
        rays = self.rays(recorded.rays()[..., :2])
        border = np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]])
        K = self._straight(recorded.K, 1.0)
        room = np.where(border < 0, K[:2, 2], np.array([recorded.width, recorded.height]) - K[:2, 2])
        return float((room / np.maximum(np.abs(border) * K.diagonal()[:2], 1e-9)).min())

    def _maps(self, recorded: Camera, K: np.ndarray, times: float) -> tuple[np.ndarray, np.ndarray]:
        """Column and row [H, W] in the recorded picture, of intrinsics K [3, 3], of each pixel of the straight one."""
        rays = replace(recorded, K=self._straight(K, times)).rays()[..., :2]
        within = 1 - 4 * self.division * (rays**2).sum(-1, keepdims=True)
        slopes = self._middle + self._focal * 2 * rays / (1 + np.sqrt(np.maximum(within, 0)))
        at = np.where(within > 0, slopes * K.diagonal()[:2] + K[:2, 2] - 0.5, _OUTSIDE).astype(np.float32)
        return at[..., 0], at[..., 1]

    def coefficients(self, recorded: Camera) -> tuple[float, float]:
        """The coefficients k1 and k2 of OpenCV that distort pictures of the camera most alike."""
        rays = self.rays(recorded.rays()[..., :2]).reshape(-1, 2)
        slopes = self._seen(recorded.rays()[..., :2].reshape(-1, 2))
        r, seen = np.linalg.norm(rays, axis=1), np.linalg.norm(slopes, axis=1)
        k1, k2 = np.linalg.lstsq(np.stack([r**3, r**5], 1), seen - r, rcond=None)[0]
        return float(k1), float(k2)


@dataclass(frozen=True)
class CameraErrors:
    """By how much recorded cameras are off, in the course of a recording.

    A pose is corrected by how what the camera sees turns, a rotation vector, rad, and how that then shifts, m.

    Args:
        stamps_ns: Of the views [V], when they were taken.
        changes: What corrects their poses [V, 6].
        gradual: Whether views tell by how much those in between are off.
        lens: What the lens does beside that.
        mount: What corrects all poses before that [6], also those of other views: the lens sits elsewhere on its arm than recorded.
    """

    stamps_ns: Sequence[int] = ()
    changes: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    gradual: bool = False
    lens: LensError = LensError()
    mount: np.ndarray = field(default_factory=lambda: np.zeros(6))

    def corrected(self, camera: Camera, stamp_ns: int) -> Camera:
        """A camera of the recording as it is: with its lens, and where views were found to be, and others where poses go off gradually."""
        camera = _changed(self.lens.camera(camera), self.mount)
        if stamp_ns not in self.stamps_ns and not self.gradual:
            return camera
        return _changed(camera, interpolated(self.stamps_ns, self.changes, stamp_ns))

    def after(self, others: CameraErrors) -> CameraErrors:
        """These and others, the lens and mount of which were corrected before."""
        if not others.mount.any():
            return replace(self, lens=others.lens)
        return replace(self, lens=others.lens, mount=change_of(displacement(others.mount) @ displacement(self.mount)))

    def told(self, distance: float) -> str:
        """What poses that training takes are, beside recorded ones: words to follow "poses that". Tissue is at a distance, m."""
        parts = []
        if self.mount.any():
            own = "shifted by ({:.2f}, {:.2f}, {:.2f}) mm along their own axes, and then turned by ({:.2f}, {:.2f}, {:.2f})°".format(
                *1e3 * displacement(self.mount)[:3, 3], *np.degrees(-self.mount[:3])
            )
            parts.append(f"are all {_how_far(self.mount[None], distance)}, as by a hand-eye calibration: {own} (rotation vector)")
        if len(self.changes):
            others = "gradually" if self.gradual else "from view to view, and those of other views stay as they are"
            parts.append(f"are {_how_far(self.changes, distance)} in the median, and go off {others}")
        return ", and then ".join(parts)


def _how_far(changes: np.ndarray, distance: float) -> str:
    """By how much changes [N, 6] turn and move poses in the median; tissue is at a distance, m."""
    turned, moved = (np.median(np.linalg.norm(part, axis=1)) for part in np.split(changes, 2, axis=1))
    return f"turned by {np.degrees(turned):.2g}° and moved by {moved / distance:.1%} of the distance of the tissue"


def _changed(camera: Camera, change: np.ndarray) -> Camera:
    """The camera with its pose corrected by a change [6]."""
    return camera.at(camera.pose @ displacement(change))


def displacement(change: np.ndarray) -> np.ndarray:
    """Pose [4, 4] of a corrected camera in the frame of the recorded one, of the change [6] that corrects it: shifted, and then turned."""
    return invert_pose(rigid_pose(cv2.Rodrigues(change[:3])[0], change[3:]))


def change_of(displaced: np.ndarray) -> np.ndarray:
    """The change [6] whose `displacement` [4, 4] that is."""
    seen = invert_pose(displaced)
    return np.append(cv2.Rodrigues(seen[:3, :3])[0], seen[:3, 3])
