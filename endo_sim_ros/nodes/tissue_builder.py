"""What physics_node receives about the tissue, and the simulation that it becomes."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.nodes.background import Background
from endo_sim_ros.physics import MotionConfig, PhysicsConfig, TissueSimulation
from endo_sim_ros.rendering import middle_depth, render_depth

# A view as wide as an endoscope's, for a camera whose intrinsics nobody has told:
_USUAL_VIEW = intrinsic_matrix(560.0, 560.0, 320.0, 256.0), 640, 512
_PIXELS_OF_DEPTH = 64  # columns of the picture in which the depth of the tissue is looked for
_CAMERAS_LATE = 1.0  # seconds after a model in which its training cameras may still be on their way


class TissueBuilder:
    """Builds the simulation of the newest model in the background, as soon as it is known from where the tissue was seen.

    Attributes:
        model: The newest model, or None.
    """

    def __init__(self) -> None:
        self.model: GaussianModel | None = None
        self._model_stamp, self._model_number, self._model_came = 0, 0, 0.0  # ns; in order of arrival; when it arrived, seconds
        self._views: tuple[int | None, np.ndarray] = None, np.zeros((0, 4, 4))  # stamp and poses of the newest training_cameras
        self._earlier_views: np.ndarray | None = None  # the newest poses [V, 4, 4] that were any
        self._view_info: tuple[int, messages.CameraInfo] | None = None  # stamp and intrinsics of the newest training cameras
        self._camera_pose: np.ndarray | None = None  # [4, 4] m, world
        self._background = Background()
        self._config: PhysicsConfig | None = None  # the options that were asked for last,
        self._still: PhysicsConfig | None = None  # and those without their motion

    @property
    def busy(self) -> bool:
        """Whether a simulation is being built."""
        return self._background.busy

    def receive_model(self, message: Any, world_frame: str) -> None:
        """Decode and keep a message of the topic gaussians.

        Raises:
            MessageError: If it cannot be used.
        """
        messages.check_frame(message, (world_frame,), messages.GAUSSIANS.name)
        self.model = messages.decode_gaussians(message)
        self._model_stamp = messages.stamp_to_ns(message.header.stamp)
        self._model_number, self._model_came = self._model_number + 1, time.monotonic()

    def receive_training_cameras(self, message: Any, world_frame: str) -> None:
        """Decode and keep a message of the topic training_cameras.

        Raises:
            MessageError: If it cannot be used.
        """
        messages.check_frame(message, (world_frame,), messages.TRAINING_CAMERAS.name)
        poses = messages.decode_poses(message)
        self._views = messages.stamp_to_ns(message.header.stamp), poses
        if len(poses):
            self._earlier_views = poses

    def receive_training_info(self, message: Any) -> None:
        """Decode and keep a message of the topic training_camera_info.

        Raises:
            MessageError: If it cannot be used.
        """
        info = messages.decode_camera_info(message, messages.TRAINING_CAMERA_INFO.name)
        self._view_info = messages.stamp_to_ns(message.header.stamp), info

    def receive_camera_pose(self, message: Any, frames: Mapping[str, np.ndarray]) -> np.ndarray:
        """Decode, keep and return a message of the topic of the camera's pose: camera-to-world [4, 4], m.

        Args:
            message: The message.
            frames: Poses [4, 4] of known frames in the world, by name.

        Raises:
            MessageError: If it cannot be used.
        """
        self._camera_pose = messages.decode_pose(message, frames, messages.CAMERA_POSE.name)
        return self._camera_pose

    def take(self) -> tuple[int, TissueSimulation, tuple[Camera, float] | None] | None:
        """The stamp of a model, ns, its simulation, and a camera with the depth of the tissue in the middle of its picture, m, or
        None where it sees none; once when they are made, else None. Raises what the making raised."""
        built = self._background.take()
        return None if built is None else built[1]

    def want(self, config: PhysicsConfig) -> None:
        """Build what was received last with these options, unless that was done; call it periodically. Other motion is no reason to, unless
        it has another file."""
        origin, poses = self._viewpoint()
        if self.model is None or poses is None:
            return
        if config is not self._config:  # most calls find nothing to do, and should cost nothing
            self._config, self._still = config, replace(config, motion=MotionConfig(file=config.motion.file))
        key = self._model_number, origin, self._has_own_cameras, self._still
        if self._background.busy or key == self._background.wish:
            return
        model, stamp, cameras = self.model, self._model_stamp, self._own_cameras()
        middle = len(poses) // 2  # where rendering_node stands as long as nobody moves the camera
        viewpoint, camera = poses[:, :3, 3], cameras[middle] if cameras else Camera(*_USUAL_VIEW, poses[middle])
        self._background.want(key, lambda: (stamp, _tissue(model, viewpoint, config, cameras), _view(model, camera)))

    def stop(self) -> None:
        """Build nothing more."""
        self._background.stop()

    def _viewpoint(self) -> tuple[str, np.ndarray | None]:
        """From where the tissue was seen: a name, and poses [V, 4, 4], m, world, or None while they may still arrive.

        The model's own cameras come first, then the camera now, then the cameras of an earlier model."""
        stamp, poses = self._views
        own = stamp == self._model_stamp
        whole = own and (not len(poses) or self._has_own_cameras)
        if not whole and time.monotonic() - self._model_came < _CAMERAS_LATE:
            return "", None
        if own and len(poses):
            return "own cameras", poses
        if self._camera_pose is not None:
            return "camera", self._camera_pose[None]
        return "earlier cameras", self._earlier_views

    @property
    def _has_own_cameras(self) -> bool:
        """Whether all about the cameras of the newest model has arrived, and there are any."""
        (stamp, poses), info = self._views, self._view_info
        return info is not None and stamp == info[0] == self._model_stamp and len(poses) > 0

    def _own_cameras(self) -> list[Camera]:
        """The cameras of the newest model, if all about them has arrived."""
        if self._view_info is None or not self._has_own_cameras:
            return []
        info = self._view_info[1]
        return [Camera(info.P[:, :3], info.width, info.height, pose) for pose in self._views[1]]


def _tissue(model: GaussianModel, viewpoint: np.ndarray, config: PhysicsConfig, cameras: list[Camera]) -> TissueSimulation:
    """A simulation that is prepared for the first tool and the first cut, which would make a step late otherwise."""
    simulation = TissueSimulation(model, viewpoint, config, cameras, render_depth)
    simulation.prepare()
    if config.kinematics == "rest" and not config.dense:
        simulation.prepare_cutting()
    return simulation


def _view(model: GaussianModel, camera: Camera) -> tuple[Camera, float] | None:
    """The camera, and how deep the tissue lies in the middle of its picture, m; None where it shows none."""
    small = camera.resized(_PIXELS_OF_DEPTH, max(round(_PIXELS_OF_DEPTH * camera.height / camera.width), 4))
    depth = middle_depth(render_depth(model, small))
    return None if depth is None else (camera, depth)
