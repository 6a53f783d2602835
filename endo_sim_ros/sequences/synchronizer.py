"""From separate streams (image, camera_info, pose, depth, …) to whole frames."""

import bisect
from typing import Any

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.messages import CameraInfo
from endo_sim_ros.sequences.calibration_files import check_baseline

STREAMS = ("image", "pose", "right", "depth", "mask")


class _Stream:
    """The messages of one stream that wait for their image, by stamp; beyond the limit the oldest go."""

    def __init__(self, limit: int):
        self.stamps: list[int] = []  # increasing
        self.latest: int | None = None  # stamp that arrived last
        self._values: dict[int, Any] = {}
        self._limit = limit

    def add(self, stamp: int, value: Any) -> None:
        if stamp not in self._values:
            bisect.insort(self.stamps, stamp)
        self._values[stamp], self.latest = value, stamp
        if len(self.stamps) > self._limit:
            self.drop_before(self.stamps[1])

    def pop(self, stamp: int) -> Any:
        self.stamps.remove(stamp)
        return self._values.pop(stamp)

    def drop_before(self, stamp: int) -> None:
        count = bisect.bisect_left(self.stamps, stamp)
        for old in self.stamps[:count]:
            del self._values[old]
        del self.stamps[:count]

    def nearest(self, stamp: int) -> tuple[int, Any] | None:
        """Distance in stamps, and message, of the one nearest to a stamp."""
        index = bisect.bisect_left(self.stamps, stamp)
        near = min(self.stamps[max(index - 1, 0) : index + 1], key=lambda other: abs(other - stamp), default=None)
        return None if near is None else (abs(near - stamp), self._values[near])


class Synchronizer:
    """Matches the messages of a recording by stamp, exactly or to the nearest within a tolerance.

    An image needs a camera_info and a pose; right image, depth and mask join where their streams exist. An image waits
    until each stream that it needs or that has spoken so far has either matched it or moved past it.

    Args:
        tolerance: Largest difference between matched stamps, seconds.
        lag: Images for which the first ones wait, so that streams that are just starting can join them.
        max_pending: Images kept while another stream is silent; their memory is what bounds it.
        max_poses: Poses kept while no image comes: they are small, and robots send up to a thousand a second.
        max_others: Messages of each other stream kept while no image comes; they are images too.
    """

    def __init__(self, tolerance: float = 0.01, *, lag: int = 2, max_pending: int = 40, max_poses: int = 10_000, max_others: int = 128):
        self.tolerance_ns = int(tolerance * 1e9)
        self._lag, self._max_pending = lag, max_pending
        self._infos: dict[str, CameraInfo] = {}
        self.streams = {name: _Stream(max_poses if name == "pose" else max_others) for name in STREAMS}
        self._emitted = 0  # stamp of the last image that left
        self._complete: list[Frame] = []
        self.dropped = {"without pose": 0, "without camera_info": 0, "out of order": 0, "repeated": 0, "invalid": 0, "without right eye": 0}

    @property
    def pending(self) -> int:
        """Number of images that wait, or that are complete and wait to be fetched."""
        return len(self.streams["image"].stamps) + len(self._complete)

    def add_info(self, eye: str, info: CameraInfo) -> None:
        """Set the camera information of the ``left`` or ``right`` eye; the latest one counts.

        Raises:
            SequenceError: If a right one has a baseline that no endoscope has; it does not count.
        """
        old = self._infos.get(eye)
        if old is None or not old.same_as(info):  # an equal one keeps its rectification maps
            if eye == "right":
                check_baseline("endoscope/right/camera_info: P", info.baseline)
            self._infos[eye] = info

    def add(self, stream: str, stamp_ns: int, value: Any) -> list[Frame]:
        """Add one decoded message of a stream and return the frames that became complete, in order.

        Raises:
            SequenceError: If a stamp is zero or an image cannot become a frame. That message is dropped; frames that
                were complete before it come with the next call.
        """
        if stamp_ns <= 0:
            raise SequenceError(f"{stream}: a stamp of zero marks an invalid message; set header.stamp")
        if stream == "image" and stamp_ns <= self._emitted:
            self.dropped["out of order"] += 1
            return []
        if stream == "image" and stamp_ns in self.streams["image"].stamps:
            self.dropped["repeated"] += 1
            return []
        self.streams[stream].add(stamp_ns, value)
        return self._collect(final=False)

    def flush(self) -> list[Frame]:
        """The frames still waiting; call at the end of a recording, while `pending` where bad images may be among them.

        Raises:
            SequenceError: As `add`.
        """
        return self._collect(final=True)

    def _collect(self, final: bool) -> list[Frame]:
        images = self.streams["image"]
        while images.stamps and (final or self._may_leave(images.stamps[0], len(images.stamps) - 1)):
            self._emitted = images.stamps[0]
            frame = self._build(self._emitted, images.pop(self._emitted))
            if frame is not None:
                self._complete.append(frame)
        complete, self._complete = self._complete, []
        return complete

    def _may_leave(self, stamp: int, newer: int) -> bool:
        """Whether an image need wait no longer, given the number of newer ones."""
        return newer >= self._max_pending or newer >= self._lag and "left" in self._infos and self._settled(stamp)

    def _settled(self, stamp: int) -> bool:
        """Whether every stream that is needed or has spoken has matched this stamp or moved past it."""
        for name in STREAMS[1:]:
            latest = self.streams[name].latest
            if latest is None:
                if name == "pose":
                    return False
            elif latest <= stamp + self.tolerance_ns and self._match(name, stamp) is None:
                return False
        return True

    def _match(self, stream: str, stamp: int) -> Any | None:
        """The nearest waiting message within the tolerance."""
        nearest = self.streams[stream].nearest(stamp)
        return nearest[1] if nearest is not None and nearest[0] <= self.tolerance_ns else None

    def _build(self, stamp: int, image: np.ndarray) -> Frame | None:
        parts = {name: part for name in STREAMS[1:] if (part := self._match(name, stamp)) is not None}
        for name in STREAMS[1:]:  # what lies further back can match no later image
            self.streams[name].drop_before(stamp - self.tolerance_ns)
        info = self._infos.get("left")
        if info is None or "pose" not in parts:
            self.dropped["without camera_info" if info is None else "without pose"] += 1
            return None
        right_info = self._infos.get("right")
        if "right" in parts and (right_info is None or right_info.baseline <= 0):  # P[0, 3] must be −fx·B
            self.dropped["without right eye"] += 1
            del parts["right"]
        try:
            return _frame(stamp, image, info, right_info, parts)
        except (ValueError, cv2.error) as error:
            self.dropped["invalid"] += 1
            raise SequenceError(str(error)) from error


def _frame(stamp: int, image: np.ndarray, info: CameraInfo, right_info: CameraInfo | None, parts: dict[str, Any]) -> Frame:
    for name, array in (("image", image), ("depth", parts.get("depth")), ("mask", parts.get("mask"))):
        if array is not None and array.shape[:2] != (info.height, info.width):
            raise SequenceError(
                f"endoscope/left: the {name} is {array.shape[1]}×{array.shape[0]} but camera_info says "
                f"{info.width}×{info.height}; publish both at the same size"
            )
    right, baseline, right_K = parts.get("right"), None, None
    if right is not None and right_info is not None:
        if not right.shape[:2] == image.shape[:2] == (right_info.height, right_info.width):
            raise SequenceError(
                f"endoscope/right: the image is {right.shape[1]}×{right.shape[0]}, its camera_info says "
                f"{right_info.width}×{right_info.height} and the left image is {image.shape[1]}×{image.shape[0]}; "
                "publish all at the same size"
            )
        right, baseline = right_info.rectify(right), right_info.baseline
        right_K = None if np.allclose(right_info.P[:, :3], info.P[:, :3]) else right_info.P[:, :3]
    mask = None if "mask" not in parts else info.rectify(parts["mask"], nearest=True)
    if not info.rectified:
        mask = info.valid if mask is None else np.minimum(mask, info.valid)
    return Frame(
        stamp_ns=stamp,
        image=info.rectify(image),
        camera=Camera(info.P[:, :3], info.width, info.height, parts["pose"]),
        right=right,
        baseline=baseline,
        right_K=right_K,
        depth=None if "depth" not in parts else info.rectify(parts["depth"], nearest=True),
        mask=mask,
    )
