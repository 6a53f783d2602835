"""Recordings of smooth tissue: analytic surfaces, cast ray by ray, whose depth is exact and which have no scene points.

`python test/smooth_tissue.py organ 0 BAG --pairs` writes one as a bag, for `endo-sim evaluate BAG`.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix, look_at
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.sequences.bag import write_bag
from endo_sim_ros.sequences.phantom.rendering import develop, quantise
from endo_sim_ros.sequences.recording import FIRST_STAMP_NS

Shape = Literal["organ", "flap", "funnel", "saddle"]
BASELINE = 0.005  # m, between the lenses of a pair
_STEPS, _EXACT = 400, 1e-7  # of a ray; m from the surface at which it ends
_FARTHEST = 0.4  # m


class Tissue(NamedTuple):
    """A surface, its colours and the way of the lens about it."""

    distance: Callable[[np.ndarray], np.ndarray]  # m to the surface, or less, of points [..., 3] (m, world); below 0 within
    waves: np.ndarray  # [N, 4]: wave numbers (1/m) and phase of the slow changes of colour
    path: Callable[[float], np.ndarray]  # pose [4, 4] at a share of the recording, -1 to 1
    field: float  # half the width of the picture at a distance of 1


def tissue(shape: Shape, seed: int = 0) -> Tissue:
    """Smooth tissue about 10 cm before the lens; sizes, directions and colours follow from the seed."""
    rng = np.random.default_rng([seed, 0x5300])
    some = rng.uniform
    waves = np.c_[rng.normal(0, 100, (9, 3)), some(0, 2 * np.pi, 9)]
    turn, bend, travel = some(0, 2 * np.pi), rng.normal(0, 1, 2), some(0.012, 0.018)
    along = np.array([np.cos(turn), np.sin(turn)])
    wall = lambda p: 0.9 * (0.13 + 0.004 * np.sin(40 * p[..., 0] + bend[0]) * np.cos(30 * p[..., 1] + bend[1]) - p[..., 2])
    aside = lambda share: look_at([travel * share, 0.3 * travel * share**2, 0.1 * travel * share], [0, 0, 0.11])
    if shape == "organ":
        size, middle = some([0.020, 0.015, 0.013], [0.030, 0.022, 0.020]), np.array([*some(-0.01, 0.01, 2), some(0.09, 0.105)])

        def organ(p: np.ndarray) -> np.ndarray:
            local = p - middle
            local = np.stack([local[..., :2] @ along, local[..., :2] @ [-along[1], along[0]], local[..., 2]], -1)
            scaled = np.linalg.norm(local / size, axis=-1)
            # A bound by the first derivative; near the middle, where that is none, by the shortest axis.
            return np.maximum(scaled * (scaled - 1) / (np.linalg.norm(local / size**2, axis=-1) + 1e-12), (scaled - 1) * size.min())

        return Tissue(lambda p: np.minimum(wall(p), organ(p)), waves, aside, 0.45)
    if shape == "flap":
        wide, long, lift, curl = some(0.018, 0.025), some(0.018, 0.024), some(0.5, 0.8), some(4, 8)
        normal, down = np.array([*(-np.sin(lift) * along), -np.cos(lift)]), np.array([*(np.cos(lift) * along), -np.sin(lift)])
        across, hinge = np.array([-along[1], along[0], 0]), np.array([*(-0.01 * along), 0.128])

        def flap(p: np.ndarray) -> np.ndarray:  # a rounded plate 3 mm thick that lifts off the wall at its hinge, and curls
            local = p - hinge
            u, v = local @ across, local @ down - long
            far = np.stack([np.abs(u) - wide, np.abs(v) - long, np.abs(local @ normal - curl * u**2)], -1)
            return 0.8 * (np.linalg.norm(np.maximum(far, 0), axis=-1) + np.minimum(far.max(-1), 0) - 0.0015)

        return Tissue(lambda p: np.minimum(wall(p), flap(p)), waves, aside, 0.45)
    if shape == "funnel":
        mouth, slope, folds = some(0.022, 0.028), some(0.16, 0.2), some(0.0005, 0.0015)

        def funnel(p: np.ndarray) -> np.ndarray:  # narrows about an axis that bends
            x, y = p[..., 0] - 2 * along[0] * p[..., 2] ** 2, p[..., 1] - 2 * along[1] * p[..., 2] ** 2
            return 0.6 * (mouth - slope * p[..., 2] + folds * np.sin(120 * p[..., 2]) - np.hypot(x, y))

        pushed = lambda share: look_at([0.004 * share, 0.003 * share**2, 0.015 * share - 0.01], [2e-3 * bend[0], 2e-3 * bend[1], 0.08])
        return Tissue(funnel, waves, pushed, 0.8)
    steep = some(5, 8)
    over = lambda p: p[..., :2] @ along
    saddle = lambda p: 0.6 * (0.11 + steep * (over(p) ** 2 - (p[..., :2] @ [-along[1], along[0]]) ** 2) - p[..., 2])
    return Tissue(saddle, waves, aside, 0.35)


def cast(scene: Tissue, camera: Camera, lamp: np.ndarray, glint: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Radiance [H, W, 3] and depth [H, W] (m) of a camera in the light of a lamp at [3] (m, world); 0 where a ray hits nothing."""
    rays = camera.rays()
    length = np.linalg.norm(rays, axis=-1)
    ways, depth = rays @ camera.pose[:3, :3].T, np.zeros(length.shape)
    going = np.ones(length.shape, bool)
    for _ in range(_STEPS):  # sphere tracing
        step = scene.distance(camera.position + ways[going] * depth[going][:, None])
        depth[going] += step / length[going]
        going[going] = (step > _EXACT) & (depth[going] < _FARTHEST)
    places = camera.position + ways * depth[..., None]
    steps = 1e-5 * np.eye(3)
    normals = np.stack([scene.distance(places + step) - scene.distance(places - step) for step in steps], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    to_lamp = lamp - places
    far = np.linalg.norm(to_lamp, axis=-1)
    facing = np.maximum((normals * to_lamp).sum(-1) / far, 0)
    stains = np.sin(places @ scene.waves[:, :3].T + scene.waves[:, 3]).reshape(*far.shape, 3, -1).mean(-1)
    colors = np.array([0.62, 0.3, 0.26]) * (1 + 0.3 * stains)
    shining = colors * facing[..., None] + glint * np.exp(150 * (facing - 1))[..., None]
    hit = depth < _FARTHEST
    return np.where(hit[..., None], shining * (0.1 / far[..., None]) ** 2, 0), np.where(hit, depth, 0).astype(np.float32)


def film(
    shape: Shape, seed: int = 0, pairs: bool = False, glint: float = 0.0, frames: int = 13, width: int = 320, noise: float = 1.0
) -> Iterator[Frame]:
    """Frames of smooth tissue, the lamp at the left lens, exposed once for all.

    Args:
        shape, seed: See `tissue`.
        pairs: Whether there is a right image, too.
        glint: Strength of highlights where tissue faces the lamp; 0 = matt.
        frames: Number of frames.
        width: Pixels of a row; there are four fifths as many rows.
        noise: Standard deviation of the sensor's noise, grey levels.
    """
    scene, rng = tissue(shape, seed), np.random.default_rng([seed, 0x5301])
    height, focal, exposure = round(0.8 * width), width / 2 / scene.field, 0.0
    K = intrinsic_matrix(focal, focal, width / 2, height / 2)
    for index, share in enumerate(np.linspace(-1, 1, frames)):
        camera = Camera(K, width, height, scene.path(share))
        looks = [cast(scene, eye, camera.position, glint) for eye in (camera, camera.beside(BASELINE))[: 1 + pairs]]
        exposure = exposure or 0.22 / np.minimum(looks[0][0], 1).mean()
        images = [develop(look.astype(np.float32), camera, exposure, False) for look, _ in looks]
        images = [quantise(image + noise * rng.standard_normal(image.shape)) for image in images]
        right = {"right": images[1], "baseline": BASELINE} if pairs else {}
        yield Frame(FIRST_STAMP_NS + index * 40_000_000, images[0], camera, depth=looks[0][1], **right)


def main(shape: Shape, seed: int, bag: Path, /, pairs: bool = False, glint: float = 0.0) -> None:
    """Write a recording as a bag."""
    write_bag(bag, film(shape, seed, pairs, glint))


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
