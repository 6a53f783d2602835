"""One built patient, and what an endoscope at any pose sees of it: a light beside the lens, optics and a sensor."""

import functools
import math

import cv2
import numpy as np
import warp as wp

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import init_warp
from endo_sim_ros.sequences.phantom import surface_kernels as kernels
from endo_sim_ros.sequences.phantom.anatomy import Anatomy
from endo_sim_ros.sequences.phantom.config import PhantomConfig
from endo_sim_ros.sequences.phantom.displacement import Displacement, displacement_at
from endo_sim_ros.sequences.phantom.height_field import CELL, CELLS, SEAM, joined, noise, smoothstep
from endo_sim_ros.sequences.phantom.paint import Paint


class Phantom:
    """One synthetic patient, ready to be seen from anywhere; `build_phantom` makes it once.

    Args:
        seed: What everything about the patient follows from.
        sections: How many organs lie side by side along x, each before its section of the wall, 28 cm apart.
    """

    def __init__(self, seed: int, sections: int = 1):
        init_warp()
        parts, seams, wall = [], [], None
        for number in range(sections):
            rng = np.random.default_rng([seed, 0x7155] + [number] * (number > 0))
            if number:  # the border between two sections bends
                along = np.linspace(0.0, 1.0, SEAM + 1) + 0.25 * np.clip(noise(rng, 0.02, 2)[:, : SEAM + 1], -1.0, 1.0)
                seams.append(smoothstep(along, 0.25, 0.75).astype(np.float32))
            anatomy = Anatomy(rng)
            paint = Paint(rng, seed, anatomy, wall)
            wall = paint.wall  # one all over
            parts.append((anatomy.heights - paint.relief, np.concatenate([paint.colour, paint.wetness[..., None]], -1), paint.film))
        heights, colours, film = (joined(fields, seams) for fields in zip(*parts))
        self.heights = np.ascontiguousarray(heights, np.float32)
        """Depth coordinate z of the surface over the vertices of its grid [y, x], metres, world."""

        slopes = np.stack([_slope(self.heights, 1), _slope(self.heights, 0), -_slope(film, 1), -_slope(film, 0)], -1)
        surface = kernels.Surface()
        surface.rows, surface.columns, surface.cell = CELLS, self.heights.shape[1] - 1, CELL
        surface.lowest, surface.highest = float(self.heights.min()), float(self.heights.max())
        surface.heights = wp.array(self.heights.ravel(), dtype=float, device="cpu", copy=False)
        surface.nearest = wp.array(_minimum_pyramid(self.heights), dtype=float, device="cpu", copy=False)
        surface.colours = wp.array(_detail_pyramid(colours), dtype=wp.vec4, device="cpu", copy=False)
        surface.slopes = wp.array(_detail_pyramid(slopes), dtype=wp.vec4, device="cpu", copy=False)
        self.surface = surface

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """World z of the surface, metres, at world x and y (any common shape), in double precision."""
        sides = self.heights.shape[1] - 1, CELLS
        u, v = (np.abs((np.asarray(c, np.float64) / CELL + 1.5 * side) % (2 * side) - side) for c, side in zip((x, y), sides))
        i, j = np.minimum(u.astype(int), sides[0] - 1), np.minimum(v.astype(int), sides[1] - 1)
        a, b = u - i, v - j
        z = self.heights.astype(np.float64)
        return (1 - b) * ((1 - a) * z[j, i] + a * z[j, i + 1]) + b * ((1 - a) * z[j + 1, i] + a * z[j + 1, i + 1])

    def fence(self, largest: float) -> np.ndarray:
        """Z [N], metres, before which no tissue is that is displaced by so many metres at most, over the cells of FENCE_LEVEL."""
        rows, columns = (side >> kernels.FENCE_LEVEL for side in (self.surface.rows, self.surface.columns))
        skipped = sum((self.surface.rows >> level) * (self.surface.columns >> level) for level in range(kernels.FENCE_LEVEL))
        nearest = self.surface.nearest.numpy()[skipped : skipped + rows * columns].reshape(rows, columns)
        reach = math.ceil(largest / (CELL * (1 << kernels.FENCE_LEVEL)))
        return cv2.erode(nearest, np.ones((2 * reach + 1,) * 2), borderType=cv2.BORDER_REFLECT).ravel() - np.float32(largest)


def build_phantom(seed: int, sections: int = 1) -> Phantom:
    """The patient of a seed, with as many organs side by side; the last few are kept."""
    return _kept(seed, sections)


_kept = functools.lru_cache(maxsize=4)(Phantom)


def _slope(field: np.ndarray, axis: int) -> np.ndarray:
    """Central difference of a field on the surface's grid, per metre."""
    return np.gradient(field, CELL, axis=axis).astype(np.float32)


def _minimum_pyramid(heights: np.ndarray) -> np.ndarray:
    """Minimal height over every cell of every level, flat; level l has (CELLS >> l) cells along y."""
    level = np.minimum(np.minimum(heights[:-1, :-1], heights[:-1, 1:]), np.minimum(heights[1:, :-1], heights[1:, 1:]))
    levels = [level.ravel()]
    while len(level) > CELLS >> kernels.TOP_LEVEL:
        level = np.minimum(np.minimum(level[::2, ::2], level[::2, 1::2]), np.minimum(level[1::2, ::2], level[1::2, 1::2]))
        levels.append(level.ravel())
    return np.concatenate(levels)


def _detail_pyramid(texture: np.ndarray) -> np.ndarray:
    """Levels of detail of a texture [rows, columns, 4] on the surface's vertices, flat [sum, 4]."""
    levels: list[np.ndarray] = [texture.astype(np.float32, copy=False)]
    for _ in range(5):
        levels.append(cv2.pyrDown(levels[-1]))
    return np.concatenate([level.reshape(-1, 4) for level in levels])


_WORKING_DISTANCE = 0.115  # metres, at which the exposure is right
_LIGHT_OFFSET = np.array([0.0027, -0.004, 0.0])  # of the fibre's end from the left lens, camera frame, metres


def radiance_and_depth(
    phantom: Phantom, camera: Camera, rig: Camera, displacement: Displacement | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Linear image [H, W, 3] and depth [H, W] of a camera, in the light of the endoscope whose left camera is `rig`."""
    motion = kernels.Motion()
    if displacement is not None:
        array = lambda values, kind: wp.array(values.astype(np.float32), dtype=kind, device="cpu")
        motion.centres, motion.amplitudes = (array(each, wp.vec3) for each in (displacement.centres, displacement.amplitudes))
        motion.radii = array(displacement.radii, float)
        largest = float(np.linalg.norm(displacement.amplitudes, axis=1).sum())
        motion.first, motion.last = phantom.surface.lowest - largest, phantom.surface.highest + largest
        motion.fence = array(phantom.fence(largest), float)
    light = kernels.Light()
    light.position = wp.vec3(*(rig.pose[:3, :3] @ _LIGHT_OFFSET + rig.position))
    light.power = 1.12 * _WORKING_DISTANCE**2
    light.wrap = wp.vec3(0.30, 0.16, 0.14)
    light.sheen, light.glint, light.sharpness = 0.13, 9.0, 700.0
    depth = np.zeros((camera.height, camera.width), np.float32)
    radiance = np.zeros((camera.height, camera.width, 3), np.float32)
    wp.launch(
        kernels.render,
        dim=depth.shape,
        inputs=[
            phantom.surface,
            motion,
            light,
            wp.mat44(camera.pose.astype(np.float32)),
            wp.vec2(camera.K[0, 0], camera.K[1, 1]),
            wp.vec2(camera.K[0, 2], camera.K[1, 2]),
            wp.array(depth, dtype=float, device="cpu", copy=False),
            wp.array(radiance, dtype=wp.vec3, device="cpu", copy=False),
        ],
        device="cpu",
    )
    return radiance, depth


def develop(radiance: np.ndarray, camera: Camera, exposure: float, auto: bool) -> np.ndarray:
    """What the optics and the sensor make of a linear image: vignette, bloom, lens blur, tone curve; float32, 0-255."""
    rays = camera.rays()
    radius2 = ((rays[..., 0] / rays[0, 0, 0]) ** 2 + (rays[..., 1] / rays[0, 0, 0]) ** 2).astype(np.float32)
    image = radiance * (exposure / (1.0 + 0.45 * radius2 + 0.35 * radius2**2))[..., None]
    if auto:
        image *= np.float32(0.22 / max(float(np.minimum(image, 1.0).mean()), 1e-6))
    scale = camera.width / 640
    highlights = np.maximum(np.minimum(image, 6.0) - 1.0, 0.0)
    image = image + 0.10 * cv2.GaussianBlur(highlights, (0, 0), 4.0 * scale) if scale > 0.2 else image
    image = cv2.GaussianBlur(image, (0, 0), max(0.75 * scale, 0.35))
    tone = 1.0 - np.exp(-1.85 * image ** np.float32(1.15))  # a toe for the shadows, a shoulder for the highlights
    return 255.0 * np.minimum(1.04 * tone, 1.0) ** np.float32(1 / 2.2)


def render_phantom(phantom: PhantomConfig | Phantom, camera: Camera, seconds: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """What an endoscope at any pose sees of the patient, without noise or border.

    Args:
        phantom: The configuration (its seed, flight, displacement, exposure and auto_exposure count), or a built phantom.
        camera: Where to look from; its light moves with it.
        seconds: Time since the first frame, for tissue that moves.

    Returns:
        The RGB image [H, W, 3], uint8, and the depth along the optical axis [H, W], float32, metres, 0 where the
        camera looks past the surface.
    """
    config = phantom if isinstance(phantom, PhantomConfig) else PhantomConfig()
    built = build_phantom(config.seed, config.sections) if isinstance(phantom, PhantomConfig) else phantom
    radiance, depth = radiance_and_depth(built, camera, camera, displacement_at(config, seconds))
    return quantise(develop(radiance, camera, config.exposure, config.auto_exposure)), depth


def quantise(image: np.ndarray) -> np.ndarray:
    """Grey levels 0-255 as uint8, rounded; what lies beyond is clamped."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
