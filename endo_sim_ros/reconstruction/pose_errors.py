"""By how much recorded poses are off, and cameras that are where they were."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera, invert_pose, rigid_pose
from endo_sim_ros.core.frames import interpolated


@dataclass(frozen=True)
class PoseErrors:
    """By how much recorded poses are off, in the course of a recording.

    Args:
        stamps_ns: Of the views [V], when they were taken.
        changes: What corrects them [V, 6]: a rotation vector, rad, by which what the camera sees turns, and how that then shifts, m.
        gradual: Whether views tell by how much those in between are off.
    """

    stamps_ns: Sequence[int] = ()
    changes: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    gradual: bool = False

    def corrected(self, camera: Camera, stamp_ns: int) -> Camera:
        """A camera of the recording where it is: as was found for the views, and in between where poses go off gradually."""
        if stamp_ns not in self.stamps_ns and not self.gradual:
            return camera
        change = interpolated(self.stamps_ns, self.changes, stamp_ns)
        return camera.at(camera.pose @ invert_pose(rigid_pose(cv2.Rodrigues(change[:3])[0], change[3:])))
