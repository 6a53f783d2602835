"""What a reconstruction is made from: training views with their depth prior, scene points, and the scene that stages prepare."""

import dataclasses
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from typing_extensions import Self

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.light import untoned
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.reconstruction.camera_errors import CameraErrors
from endo_sim_ros.reconstruction.stage_configs import UsableViewsConfig

log = logging.getLogger(__name__)
_EVEN_SHARE = 0.95  # of a view's tissue, that is of one colour or the same to both eyes
_TELL = 5000  # pixels that tell such a share


class ScenePoints(NamedTuple):
    """Points on the tissue, as structure from motion gives them."""

    positions: np.ndarray  # [N, 3] m, world
    colors: np.ndarray  # [N, 3] RGB in [0, 1]
    error: np.ndarray | float = 0.01  # [N] of the depth, relative, that a pixel's error makes

    @classmethod
    def recorded(cls, positions: np.ndarray, colors: np.ndarray) -> "ScenePoints":
        """Points that a recording brings, of structure from motion with all its views, whose depth errs less."""
        return cls(positions, colors, 0.003)

    def moved_by(self, motion: TissueMotion | None) -> Callable[[int], "ScenePoints"]:
        """Where the points, which are in their mean positions, are at the time of a stamp (ns)."""
        if motion is None or not len(self.positions):
            return lambda _: self
        shares = motion.shares(self.positions)
        return lambda stamp_ns: self._replace(positions=self.positions + shares @ motion.paths(stamp_ns))

    @classmethod
    def none(cls) -> "ScenePoints":
        """No points at all."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))


class Matches(NamedTuple):
    """Features that two views share."""

    views: tuple[int, int]
    first: np.ndarray  # [M, 2] pixels
    second: np.ndarray  # [M, 2] pixels


class PointPixels(NamedTuple):
    """The pixels of those points that lie in a picture, hidden or not."""

    index: np.ndarray  # [M] of the points
    rows: np.ndarray  # [M]
    columns: np.ndarray  # [M]
    depth: np.ndarray  # [M] m


def pixels_of(camera: Camera, points: np.ndarray) -> PointPixels:
    """The pixels of points [N, 3] (m, world)."""
    uv, z = camera.project(points)
    index = np.nonzero(camera.contains(uv, z))[0]
    columns, rows = np.floor(uv[index]).astype(int).T
    return PointPixels(index, rows, columns, z[index])


@dataclass(frozen=True)
class TrainingView(Frame):
    """A view to train on: a frame, whose `depth` is what was measured, and the depth that training starts from and is held to.

    Args:
        depth_prior: Depth along the optical axis [H, W], float32, metres; 0 = none; None = none anywhere.
        paths: Of tissue that moves by itself, the `TissueMotion.paths` of when it was taken; None = it is in its mean position.
        shoulder: That of the camera's tone curve, see `Light`.
    """

    depth_prior: np.ndarray | None = None
    paths: np.ndarray | None = None
    shoulder: float = 0.0

    @property
    def brightness(self) -> np.ndarray:
        """What the camera's tone curve makes the image of [H, W, 3], float32; white without a curve is 1."""
        return untoned(self.image / np.float32(255), self.shoulder)

    @property
    def surface(self) -> np.ndarray:
        """The depth prior [H, W], m; zeros if there is none anywhere."""
        return np.zeros(self.image.shape[:2], np.float32) if self.depth_prior is None else self.depth_prior

    @classmethod
    def of(cls, frame: Frame) -> Self:
        """The view of a frame, without a prior."""
        return cls(**{item.name: getattr(frame, item.name) for item in dataclasses.fields(Frame)})


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """What the stages of a preparation have found so far; after the last one, what a training needs.

    Args:
        frames: Usable frames, as they were recorded; none when poses are checked and depth is known, since they take much memory.
        views: The same as they are trained on: shrunk, with depth prior and mask of what is still; with their rectified right images until
            depth is refined.
        points: Scene points; none before they are found.
        given_points: Whether the caller gave them.
        motion: How the tissue moves by itself. Frames and model have it in its mean position; views, at last, where it was.
        recorded: Where the tissue moves, the views as they were recorded, by their stamps; with right images until poses are corrected.
        still_depth: Where it moves, its depth in the mean position [H, W], m, as pairs tell it, by the stamps of the views.
        matches: Features that the frames share.
        depth_source: Where the depth prior is from: topic, stereo, network, points or none.
        model: Gaussians to start from; none before they are placed.
        iterations: Number of optimisation steps.
        max_gaussians: Largest number of Gaussians.
        fading: Factor on the weights of their opacity and size in the loss.
        without_depth: Whether the training has none of the depth that one lens tells, as plain 3DGS: Gaussians are added by gradients,
            and without a surface there is no light that falls with distance. None = a trial decides.
        depth: Median depth of the scene, metres.
        light: Of the light at the camera (distance, angle, tilt_x, tilt_y) [4].
        exposures: Logarithm of each view's exposure [V, 3].
        fixed_exposure: Whether that is the same in all views, and stays so.
        camera_errors: By how much recorded poses and the lens were off; views have them corrected.
        decisions: What the stages decided, a sentence each.
        warnings: Those of them that a user should know of.
    """

    frames: tuple[Frame, ...]
    views: tuple[TrainingView, ...] = ()
    points: ScenePoints = ScenePoints.none()
    given_points: bool = False
    motion: TissueMotion | None = None
    recorded: dict[int, TrainingView] = field(default_factory=dict)
    still_depth: dict[int, np.ndarray | None] = field(default_factory=dict)
    matches: tuple[Matches, ...] = ()
    depth_source: str = "none"
    model: GaussianModel = field(default_factory=lambda: GaussianModel.from_points(torch.empty(0, 3), torch.empty(0, 3), torch.empty(0)))
    iterations: int = 0
    max_gaussians: int = 0
    fading: float = 1.0
    without_depth: bool | None = None
    depth: float = 0.0
    light: np.ndarray = field(default_factory=lambda: np.zeros(4))
    exposures: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    fixed_exposure: bool = False
    camera_errors: CameraErrors = CameraErrors()
    decisions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def depth_is_recorded(self) -> bool:
        """Whether the depth prior, if there is one, was recorded, not told from the images: by stereo matching, points or a network."""
        return self.depth_source in ("topic", "none")

    def decided(self, sentence: str, level: int = logging.WARNING) -> Self:
        """A copy that knows of a decision, which is logged."""
        log.log(level, "%s", sentence)
        warnings = (sentence,) if level >= logging.WARNING else ()
        return dataclasses.replace(self, decisions=(*self.decisions, sentence), warnings=(*self.warnings, *warnings))


AnyFrame = TypeVar("AnyFrame", bound=Frame)


def shrink(frame: AnyFrame, width: int) -> AnyFrame:
    """The frame or view at the given width (pixels), if it is wider; the intrinsics follow.

    Colours are averaged; depth is that at the pixel's centre; a pixel is tissue if all that it averages is.
    """
    camera = frame.camera
    if camera.width <= width:
        return frame
    size = (width, max(round(camera.height * width / camera.width), 1))
    average = lambda image: cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    all_tissue = 0.999  # share of a pixel: an average of ones may be rounded
    depths = {name: getattr(frame, name, None) for name in ("depth", "depth_prior")}
    scale = np.diag([size[0] / camera.width, size[1] / camera.height, 1])
    return dataclasses.replace(
        frame,
        image=average(frame.image),
        camera=camera.resized(*size),
        right=None if frame.right is None else average(frame.right),
        right_K=None if frame.right_K is None else scale @ frame.right_K,
        mask=None if frame.mask is None else np.uint8(255) * (average(np.float32(frame.mask > 0)) > all_tissue),
        **{name: resized_depth(depth, *size) for name, depth in depths.items() if depth is not None},
    )


def resized_depth(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth [H, W] in another size, pixels: that at the centre of each pixel."""
    # Plain INTER_NEAREST takes the corner instead of the centre.
    return cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)


def unusable(frame: Frame, options: UsableViewsConfig = UsableViewsConfig()) -> str:
    """Why a frame shows no tissue, in a word; nothing if it shows some."""
    mask = frame.mask
    if mask is not None and not mask.any():
        return "masked"
    some = np.s_[::4, ::4] if mask is None or mask[::4, ::4].any() else np.s_[:]  # a sixteenth of the pixels tells, of thousands of frames
    pixels = frame.image[some].reshape(-1, 3) if mask is None else frame.image[some][mask[some] > 0]
    channels = np.ascontiguousarray(pixels.T)  # twenty times as fast to go through
    if (np.minimum.reduce(channels) >= options.white).mean() > options.overexposed_share:
        return "overexposed"
    if (np.maximum.reduce(channels) <= options.black).mean() > options.black_share:
        return "black"
    sampled = channels[:, :: max(channels.shape[1] // _TELL, 1)]  # a median takes longer than all else
    apart = np.abs(sampled - np.median(sampled, axis=1, keepdims=True)).max(0)
    return "of one colour" if (apart < options.even).mean() > _EVEN_SHARE else ""


def useless_right(frame: Frame, options: UsableViewsConfig = UsableViewsConfig()) -> str:
    """Why a frame's right image tells no depth, in words; nothing if it may, or if there is none."""
    if frame.right is None:
        return ""
    if reason := unusable(dataclasses.replace(frame, image=frame.right, mask=None), options):
        return reason
    some = np.s_[::4, ::4]
    apart = np.abs(frame.right[some].astype(np.int16) - frame.image[some]).max(-1)[frame.tissue[some] > 0]
    return "the left ones once more" if len(apart) and (apart <= 1).mean() > _EVEN_SHARE else ""
