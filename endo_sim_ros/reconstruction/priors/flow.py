"""What the optical flow between an image and its prediction from another one tells of depth."""

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, pad

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import one_at_a_time
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.kernels import launch, load_kernels
from endo_sim_ros.reconstruction.highlights import highlights
from endo_sim_ros.reconstruction.priors import flow_kernels
from endo_sim_ros.reconstruction.priors.inverse_depth import blur
from endo_sim_ros.reconstruction.stage_configs import MultiViewConfig

_RADIUS, _STRIDE = 3, 2  # of the patches of flow on a GPU, pixels
_NOISE = 1.0  # grey levels; a patch with less in it stays where smaller images had it
_STEPS = 5  # of each patch in each size of the images
_COARSEST = 16  # pixels, the shorter side of the smallest image


class EyeImage(NamedTuple):
    """What one eye of a view sees, freed of what differs between images of the same tissue."""

    camera: Camera
    grey: np.ndarray  # [H, W] uint8, freed of light and contrast
    bits: np.ndarray  # [H, ⌈W / 8⌉] uint8, the matte in an eighth of its memory, as images of all views are kept

    def on(self, device: str) -> tuple[Tensor, Tensor]:
        """Grey levels [H, W] and tissue without reflections of the light [H, W], 1 or 0, float32, on a device."""
        matte = np.unpackbits(self.bits, 1, count=self.camera.width)
        return torch.from_numpy(self.grey).to(device).float(), torch.from_numpy(matte).to(device).float()

    def with_matte(self, matte: np.ndarray) -> "EyeImage":
        """The same with another matte [H, W], 0 where it does not count."""
        return self._replace(bits=np.packbits(matte > 0, 1))


class FlowCorrection(NamedTuple):
    """What another image tells of a view's depth."""

    correction: Tensor  # [H, W] 1/m, of inverse depth
    precision: Tensor  # [H, W] m², 0 where it tells nothing


def eye_image(frame: Frame, options: MultiViewConfig) -> EyeImage:
    """The image of a frame, for `flow_correction`."""
    tissue, width = frame.tissue, frame.camera.width
    grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    around = lambda values: blur(values, options.contrast_window, width)
    share = np.maximum(around(tissue), 1e-3)
    mean = around(grey * tissue) / share
    variance = np.maximum(around(grey * grey * tissue) / share - mean * mean, 0)
    grey = np.clip(128 + 40 * (grey - mean) / np.sqrt(variance + 4), 0, 255).astype(np.uint8)  # 2 grey levels are noise
    return EyeImage(frame.camera, grey, np.packbits((tissue > 0) & ~highlights(frame.image, tissue, options.reflection), 1))


def prepare_flow(device: str) -> None:
    """Load what flow needs on a device, before several threads ask for it."""
    if device != "cpu":
        load_kernels((flow_kernels,), device)


def flow_correction(
    inverse: Tensor, own: EyeImage, other: EyeImage, options: MultiViewConfig, ways: np.ndarray | None = None
) -> FlowCorrection | None:
    """What another image tells of a view's inverse depth [H, W] (1/m, float32), on its device; None where nothing can tell.

    Where the tissue has moved between the two, ``ways`` tell how far, of what is at the view's pixels [H, W, 3], m, world.

    The view's image is predicted from the other with its depth. Flow between prediction and image, along the direction in which depth
    moves a pixel, is a correction of inverse depth; across it, it is from poses, calibration or motion.
    """
    seen = *own.on(str(inverse.device)), *other.on(str(inverse.device))
    with one_at_a_time(inverse.device):
        return _corrected(inverse, own.camera, other.camera, *seen, options, ways)


def _corrected(
    inverse: Tensor,
    camera: Camera,
    other: Camera,
    grey: Tensor,
    matte: Tensor,
    other_grey: Tensor,
    other_matte: Tensor,
    options: MultiViewConfig,
    ways: np.ndarray | None,
) -> FlowCorrection | None:
    """As `flow_correction`, with grey levels and mattes [H, W] of both images on a device."""
    unit = camera.width / 640
    moved = None if ways is None else torch.from_numpy(ways @ other.viewmat[:3, :3].T).to(inverse)
    u, v, z = _project(camera, inverse, other, moved)
    inside = (z > 0) & (_sample(other_matte, u, v, "nearest") > 0)
    if min(inside.shape) < 16 or not inside.any():  # pixels, which optical flow needs
        return None
    step = 0.01 * inverse
    ahead = _project(camera, inverse + step, other, moved)
    along_u, along_v = ((there - here) / step for there, here in zip(ahead, (u, v)))
    del z, ahead  # each image of numbers takes as much memory as two of colours
    columns, rows, good = _led_to(grey, torch.where(inside, _sample(other_grey, u, v), grey), unit, options)
    good &= inside & (matte > 0) & (_sample(inside.float(), columns, rows, "nearest") > 0)
    seen_u, seen_v = _sample(torch.stack([u, v]), columns, rows)
    alike = _correlation(grey, _sample(other_grey, seen_u, seen_v))
    off_u, off_v = seen_u - u, seen_v - v
    speed = (along_u**2 + along_v**2).clamp_min(1e-9)  # squared pixels per 1/m
    beside = (along_u * off_v - along_v * off_u).abs() / speed.sqrt()
    good &= (beside < options.max_beside * unit) & (torch.hypot(off_u, off_v) < options.max_flow * unit)
    if not good.any():
        return None
    # Across the line no depth tells anything: what is off there is what poses, calibration and flow are off along it, too.
    error = options.flow_error * max(1.4826 * float(beside[good].median()), 0.01)
    precision = torch.where(good, speed * (alike / error) ** 2, 0)
    return FlowCorrection(torch.where(good, (along_u * off_u + along_v * off_v) / speed, 0), precision)


def _led_to(image: Tensor, predicted: Tensor, unit: float, options: MultiViewConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Columns and rows [H, W] that optical flow leads to from an image to its prediction, and whether it can be believed [H, W]."""
    # The way back, a mere check, is told in images of half the size: a fifth of all the time, and a hundredth of the precision.
    flow, back = _flow(image, predicted), _flow(predicted, image, finest=1)
    height, width = image.shape
    columns = torch.arange(width, device=image.device) + 0.5 + flow[..., 0]
    rows = torch.arange(height, device=image.device)[:, None] + 0.5 + flow[..., 1]
    returns = torch.hypot(*(flow.permute(2, 0, 1) + _sample(back.permute(2, 0, 1), columns, rows))) < options.max_round_trip
    return columns, rows, returns & (flow.abs().amax(2) < options.max_flow * unit)


def _flow(image: Tensor, other: Tensor, finest: int = 0) -> Tensor:
    """By how many pixels [H, W, 2] what an image [H, W] shows lies elsewhere in another; ``finest`` halvings are left out.

    On a CPU by OpenCV, on a GPU by the same method without its last, variational part, which took most of the time there.
    """
    if image.device.type == "cpu":
        flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        flow.setFinestScale(finest)
        return torch.from_numpy(flow.calc(image.byte().numpy(), other.byte().numpy(), None))
    return dense_flow(image, other, finest)


def dense_flow(image: Tensor, other: Tensor, finest: int = 0) -> Tensor:
    """As `_flow`, by kernels: dense inverse search (Kroeger et al. 2016), a patch for every pixel, from small images to large ones."""
    sizes, device = [(image.contiguous(), other.contiguous())], str(image.device)
    load_kernels((flow_kernels,), device)
    while min(sizes[-1][0].shape) >= 2 * _COARSEST:
        halved = avg_pool2d(torch.stack(sizes[-1])[:, None], 2, ceil_mode=True, count_include_pad=False)
        sizes.append((halved[0, 0], halved[1, 0]))
    flow = image.new_zeros(*sizes[-1][0].shape, 2)
    for level in range(len(sizes) - 1, -1, -1):
        here, there = sizes[level]
        if flow.shape[:2] != here.shape:
            larger = interpolate(flow.permute(2, 0, 1)[None], scale_factor=2, mode="bilinear", align_corners=False)[0]
            flow = 2 * larger.permute(1, 2, 0)[: here.shape[0], : here.shape[1]].contiguous()
        if level >= finest:
            found = torch.empty_like(flow)
            launch(flow_kernels.search, here.numel(), [here, there, flow, _RADIUS, _NOISE, _STEPS, found], device)
            launch(flow_kernels.blend, here.numel(), [here, there, found, _RADIUS, _STRIDE, flow], device)
    return flow


def _project(camera: Camera, inverse: Tensor, other: Camera, moved: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Where another camera sees a view's pixels of the given inverse depth [H, W], which have moved [H, W, 3], m, in its own frame: u, v
    and z [H, W]."""
    motion = (other.viewmat @ camera.pose)[:3]
    count = lambda size: torch.arange(size, device=inverse.device, dtype=torch.float64)
    x, y = (count(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0], (count(camera.height) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    # Scaled by inverse depth, which leaves u and v alone, z keeps its sign.
    moved = inverse.new_zeros(1, 1, 3) if moved is None else moved
    ray = lambda row, way: (row[0] * x + row[1] * y[:, None] + row[2]).float() + inverse * (row[3] + way)
    x, y, z = (ray(row, way) for row, way in zip(motion.tolist(), moved.unbind(2)))
    K, ahead = other.K.tolist(), z > 1e-3
    far = inverse.new_tensor(-1e4)  # out of any picture
    u, v = (torch.where(ahead, a / z * f + c, far) for a, f, c in ((x, K[0][0], K[0][2]), (y, K[1][1], K[1][2])))
    return u, v, z


def _sample(image: Tensor, u: Tensor, v: Tensor, mode: str = "bilinear") -> Tensor:
    """Values of an image [H, W], or of several [C, H, W], at pixels u, v [H, W]; 0 beyond it."""
    *_, height, width = image.shape
    where = torch.stack([u * (2 / width) - 1, v * (2 / height) - 1], -1)
    values = grid_sample(image.reshape(1, -1, height, width), where[None], mode, align_corners=False)[0]
    return values if image.ndim == 3 else values[0]


def _correlation(a: Tensor, b: Tensor) -> Tensor:
    """Correlation [H, W] of two images over windows of 11 × 11 pixels, none below 0."""

    def mean(values: Tensor) -> Tensor:
        if values.device.type == "cpu":  # where OpenCV takes a tenth of the time
            return torch.from_numpy(cv2.blur(values.numpy(), (11, 11)))
        padded = pad(values[None, None], (5, 5, 5, 5), "reflect")
        return avg_pool2d(padded, 11, 1)[0, 0]

    a, b = a - 128, b - 128  # the middle of the grey levels: squares lose fewer digits
    ma, mb = mean(a), mean(b)
    spread = ((mean(a * a) - ma * ma) * (mean(b * b) - mb * mb)).clamp_min(1e-3)
    return ((mean(a * b) - ma * mb) / spread.sqrt()).clamp(0, 1)
