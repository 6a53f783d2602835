"""From separate streams (image, camera_info, pose, depth, …) to whole frames."""

from typing import Any

import numpy as np

from endo_sim_ros.cameras import Camera
from endo_sim_ros.messages import CameraInfo
from endo_sim_ros.sequences.frames import Frame, SequenceError

STREAMS = ("image", "pose", "right", "depth", "mask")
LAG = 2  # images to wait for streams that are just starting
MAX_PENDING = 40  # images kept while an optional stream is silent


class Synchronizer:
    """Matches the messages of a recording by stamp, exactly or to the nearest within a tolerance.

    An image needs a pose; right image, depth and mask join where their streams exist. An image waits until each stream
    that has spoken so far has either matched it or moved past it.

    Args:
        tolerance: Largest difference between matched stamps, seconds.
    """

    def __init__(self, tolerance: float = 0.01):
        self.tolerance_ns = int(tolerance * 1e9)
        self._infos: dict[str, CameraInfo] = {}
        self._waiting: dict[str, dict[int, Any]] = {name: {} for name in STREAMS}
        self._newest: dict[str, int] = {}
        self._emitted = 0  # stamp of the last image that left
        self.dropped = {"without pose": 0, "without camera_info": 0, "out of order": 0, "invalid": 0}

    def add_info(self, eye: str, info: CameraInfo) -> None:
        """Set the camera information of the ``left`` or ``right`` eye; the latest one counts."""
        self._infos[eye] = info

    def add(self, stream: str, stamp_ns: int, value: Any) -> list[Frame]:
        """Add one decoded message of a stream and return the frames that became complete, in order.

        Raises:
            SequenceError: If a stamp is zero or an image cannot become a frame; that image is dropped, the rest goes on.
        """
        if stamp_ns <= 0:
            raise SequenceError(f"{stream}: a stamp of zero marks an invalid message; set header.stamp")
        if stream == "image" and stamp_ns <= self._emitted:
            self.dropped["out of order"] += 1
            return []
        self._waiting[stream][stamp_ns] = value
        self._newest[stream] = max(stamp_ns, self._newest.get(stream, 0))
        return self._collect(final=False)

    def flush(self) -> list[Frame]:
        """The frames still waiting; call at the end of a recording."""
        return self._collect(final=True)

    def _collect(self, final: bool) -> list[Frame]:
        frames = []
        images = self._waiting["image"]
        for stamp in sorted(images):
            newer = sum(other > stamp for other in images)
            if not final and newer < MAX_PENDING and (newer < LAG or not self._settled(stamp)):
                break
            image = images.pop(stamp)
            self._emitted = stamp
            frame = self._build(stamp, image)
            if frame is not None:
                frames.append(frame)
        return frames

    def _settled(self, stamp: int) -> bool:
        """Whether every stream that has spoken has matched this stamp or moved past it."""
        return all(
            self._match(name, stamp) is not None or self._newest[name] > stamp + self.tolerance_ns
            for name in STREAMS[1:]
            if name in self._newest
        )

    def _match(self, stream: str, stamp: int) -> int | None:
        """Stamp of the nearest waiting message within the tolerance."""
        nearest = min(self._waiting[stream], key=lambda other: abs(other - stamp), default=None)
        return nearest if nearest is not None and abs(nearest - stamp) <= self.tolerance_ns else None

    def _build(self, stamp: int, image: np.ndarray) -> Frame | None:
        parts = {name: self._waiting[name][key] for name in STREAMS[1:] if (key := self._match(name, stamp)) is not None}
        for name in STREAMS[1:]:  # what lies further back can match no later image
            for old in [key for key in self._waiting[name] if key < stamp - self.tolerance_ns]:
                del self._waiting[name][old]
        info = self._infos.get("left")
        missing = "camera_info" if info is None else "pose" if "pose" not in parts else None
        if missing:
            self.dropped[f"without {missing}"] += 1
            return None
        try:
            return _frame(stamp, image, info, self._infos.get("right"), parts)
        except ValueError as error:
            self.dropped["invalid"] += 1
            raise SequenceError(str(error)) from error


def _frame(stamp: int, image: np.ndarray, info: CameraInfo, right_info: CameraInfo | None, parts: dict[str, Any]) -> Frame:
    for name, array in (("image", image), ("depth", parts.get("depth")), ("mask", parts.get("mask"))):
        if array is not None and array.shape[:2] != (info.height, info.width):
            raise SequenceError(
                f"endoscope/left: the {name} is {array.shape[1]}×{array.shape[0]} but camera_info says "
                f"{info.width}×{info.height}; publish both at the same size"
            )
    right = parts.get("right") if right_info is not None and right_info.baseline > 0 else None
    if right is not None and right.shape != image.shape:
        raise SequenceError(f"endoscope/right: the image is {right.shape[1]}×{right.shape[0]}, the left {image.shape[1]}×{image.shape[0]}")
    return Frame(
        stamp_ns=stamp,
        image=info.rectify(image),
        camera=Camera(info.P[:, :3], info.width, info.height, parts["pose"]),
        right=None if right is None else right_info.rectify(right),
        baseline=None if right is None else right_info.baseline,
        right_K=None if right is None or np.allclose(right_info.P[:, :3], info.P[:, :3]) else right_info.P[:, :3],
        depth=None if "depth" not in parts else info.rectify(parts["depth"], nearest=True),
        mask=None if "mask" not in parts else info.rectify(parts["mask"], nearest=True),
    )
