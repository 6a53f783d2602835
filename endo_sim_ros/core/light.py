"""The light that travels with an endoscope, its falloff, and the automatic exposure and the tone curve of the camera.

A model's colours are those of tissue on the optical axis at a reference distance. In an image the tissue is brighter near
the camera and darker towards the edge, and the exposure scales the whole picture. Brightness is that of encoded
(gamma-compressed) images, as cameras deliver and 3DGS models store them. Above some brightness a camera's curve flattens (its shoulder),
so that what is bright keeps its texture: see `toned`.
"""

import dataclasses
import functools
import json
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera

_SHARPNESS = 6  # exponent of the mean that the exposure responds to: mostly to the brighter parts of a picture
_STRIDE = 4  # pixels from one that the exposure measures to the next
SURFACE = 0.5  # alpha above which a pixel shows a surface
_LOBES = {"sheen_sharpness", "glint_sharpness", "facing"}  # what lights had not before there were reflections
_LATER = [set(), {"shoulder"}, {"shoulder", "filled"}, {"shoulder", "filled"} | _LOBES]  # what lights of older files lack
NEAREST = 1e-3  # least depth of lit tissue, metres, and alpha above which a pixel has a depth


@dataclass(frozen=True)
class Light:
    """Brightness of a point at distance d and slopes (x/z, y/z) = (x, y) in the camera, relative to the model's colour:
    exp(−distance·log(d/reference) + angle·log(cos θ) + tilt_x·x + tilt_y·y), times the exposure.

    The exposure of channel c is exp(level_c − response·log B), B the brightness of the picture without it: the mean of
    the brightest channel to the power 6, to the power 1/6, over tissue.

    Args:
        distance: Exponent of the falloff with distance; 2 / 2.2 for the inverse-square law and a gamma of 2.2.
        angle: Exponent of the falloff towards the edge, cos θ to this power, θ from the optical axis.
        tilt_x, tilt_y: Slopes of the logarithm of brightness across the picture: a light beside the lens.
        reference: Distance at which colours are the model's, metres.
        level_r, level_g, level_b: Logarithm of the exposure at B = 1.
        response: How far the camera evens out brightness: 1 holds it constant, 0 is a fixed exposure.
        sheen_sharpness, glint_sharpness: How narrow the two lobes are in which wet tissue reflects, see `reflections`.
        facing: Exponent of the cosine between the tissue's normal and the direction towards the lens, there.
        filled: 1 where holes take the colour around them, see `surroundings`, and 0 where they are black.
        shoulder: How far below white the camera's curve begins to flatten, see `toned`; 0 = it clips.
    """

    distance: float = 0.0
    angle: float = 0.0
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    reference: float = 0.1
    level_r: float = 0.0
    level_g: float = 0.0
    level_b: float = 0.0
    response: float = 0.0
    sheen_sharpness: float = 0.0
    glint_sharpness: float = 0.0
    facing: float = 0.0
    filled: float = 0.0
    shoulder: float = 0.0

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            number = isinstance(value, (int, float)) and math.isfinite(value) and abs(value) < 1e3
            if not number or name == "reference" and value <= 0:
                raise ValueError(f"light: {name} is {value!r}; it must be a number from −999 to 999{', above 0' * (name == 'reference')}")

        for name in _LOBES:
            if getattr(self, name) < 0:
                raise ValueError(f"light: {name} is {getattr(self, name)!r}; it must be 0 or more")
        if self.filled not in (0, 1):
            raise ValueError(f"light: filled is {self.filled!r}; it must be 0 or 1")
        if not 0 <= self.shoulder <= 1:
            raise ValueError(f"light: shoulder is {self.shoulder!r}; it must be from 0 to 1")

    def to_json(self) -> str:
        """Return the values as one line, for a file's comment or a message."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str) -> "Light":
        """Return the light that `to_json` wrote, or wrote before there were reflections, holes that are filled, or a shoulder.

        Raises:
            ValueError: If the text is not JSON, values are missing or unknown, or one of them is out of range.
        """
        values = json.loads(text)
        known = {field.name for field in dataclasses.fields(Light)}
        if not isinstance(values, dict) or set(values) not in [known - later for later in _LATER]:
            raise ValueError(f"light: expected the values {', '.join(sorted(known))}, got {text[:80]}")
        return Light(**values)


@functools.lru_cache(maxsize=64)
def _directions(fx: float, fy: float, cx: float, cy: float, width: int, height: int, device: torch.device) -> Tensor:
    x = (torch.arange(width, dtype=torch.float64) + 0.5 - cx) / fx
    y = (torch.arange(height, dtype=torch.float64) + 0.5 - cy) / fy
    y, x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([-0.5 * (1 + x * x + y * y).log(), x, y]).to(device, torch.float32)


def directions(camera: Camera, device: torch.device | str) -> Tensor:
    """Return of a camera's pixels [3, H, W]: the logarithm of the cosine of the angle from the axis, and the slopes x/z and y/z."""
    K = camera.K
    return _directions(*(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])), camera.width, camera.height, torch.device(device))


def features(depths: Tensor, alphas: Tensor, directions: Tensor, reference: float) -> Tensor:
    """Return the four features [4, H, W] that brightness depends on: −log(d/reference), log cos θ, x/z and y/z; no gradient.

    Args:
        depths: Composited depths Σ w z [H, W], metres.
        alphas: Opacities Σ w [H, W].
        directions: The `directions` of the camera's pixels [3, H, W].
        reference: Distance at which colours are the model's, metres.
    """
    depth = depths.detach() / alphas.detach().clamp_min(NEAREST)
    # Where nothing is drawn there is nothing to be lit.
    distance = torch.where(alphas > NEAREST, depth.clamp_min(NEAREST) / reference, 1).log() - directions[0]
    return torch.cat([-distance[None], directions])


def features_from(motion: np.ndarray, directions: Tensor, depths: Tensor, alphas: Tensor, reference: float) -> Tensor:
    """Return the `features` [4, H, W] that a camera's pixels have from another place, where the lamp is; no gradient.

    Args:
        motion: From the camera to the lamp, whose axis is its own z [3, 4], m.
        directions, depths, alphas, reference: As for `features`, of the camera's own pixels.
    """
    z = torch.where(alphas > NEAREST, depths.detach() / alphas.detach().clamp_min(NEAREST), reference)
    # Numbers, not a tensor, for whose copy the host would wait.
    x, y, ahead = (a * directions[1] * z + b * directions[2] * z + c * z + d for a, b, c, d in motion.tolist())
    ahead = ahead.clamp_min(NEAREST)
    x, y = x / ahead, y / ahead
    return features(ahead, torch.ones_like(ahead), torch.stack([-0.5 * (1 + x * x + y * y).log(), x, y]), reference)


def falloff(features: Tensor, theta: Tensor) -> Tensor:
    """Return brightness [...] of features [4, ...] for the exponents (distance, angle, tilt_x, tilt_y) [4] of a light."""
    # Not einsum: the gradient of a matrix product has other last bits with other numbers of threads.
    return (features * theta.view(-1, *[1] * (features.ndim - 1))).sum(0).exp()


def toned(brightness: Tensor, shoulder: Tensor | float) -> Tensor:
    """Return what a camera makes of brightness [...]: itself up to 1 − shoulder, then a parabola of the same slope, which is flat where it
    reaches white, at 1 + shoulder. With 0.8 it differs by 1.6 % of white at most from 1 − exp(−light) encoded with a gamma of 2.2.

    Args:
        brightness: That of an encoded image, 0 or more.
        shoulder: Above 0, up to 1; with a gradient, as for ``brightness``.
    """
    rise = ((brightness - (1 - shoulder)) / (2 * shoulder)).clamp(0, 1)
    below = brightness.clamp(max=1 - shoulder)  # pyright: ignore[reportArgumentType]  (a number or a tensor)
    return below + shoulder * rise * (2 - rise)


def untoned(image: np.ndarray, shoulder: float) -> np.ndarray:
    """Return the brightness of which a camera makes an image of values from 0 to 1, the least where it is white; float32."""
    image = image.astype(np.float32, copy=False)
    if not shoulder:
        return image
    knee = np.float32(1 - shoulder)
    left = np.sqrt(np.clip((1 - image) / np.float32(shoulder), 0, 1))  # of the slope
    return np.minimum(image, knee) + 2 * np.float32(shoulder) * (1 - left)


def log_brightness(image: Tensor, valid: Tensor) -> Tensor:
    """Return the logarithm, a scalar, of the brightness that an automatic exposure measures in an image.

    Args:
        image: Colours [H, W, 3].
        valid: Pixels that are measured, True or 1 [H, W].
    """
    peak = image[::_STRIDE, ::_STRIDE].amax(-1).clamp(1e-3, 10)
    weights = valid[::_STRIDE, ::_STRIDE].to(peak.dtype)
    mean = (weights * peak**_SHARPNESS).sum() / weights.sum().clamp_min(1)
    return mean.clamp_min(1e-12).log() / _SHARPNESS


def features_at(points: np.ndarray, camera: Camera, reference: float) -> np.ndarray:
    """Return the `features` [N, 4] of points [N, 3], metres, world, in front of a camera."""
    local = (points - camera.position) @ camera.pose[:3, :3]
    distance = np.linalg.norm(local, axis=1)
    slopes = local[:, :2] / local[:, 2:]
    return np.stack([-np.log(distance / reference), np.log(local[:, 2] / distance), *slopes.T], 1)
