"""The film: frames with exact pose and depth."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import cpu_threads
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.sequences.phantom.config import PhantomConfig
from endo_sim_ros.sequences.phantom.displacement import displacement_at
from endo_sim_ros.sequences.phantom.path import phantom_camera, phantom_poses
from endo_sim_ros.sequences.phantom.rendering import build_phantom, develop, quantise, radiance_and_depth
from endo_sim_ros.sequences.recording import FIRST_STAMP_NS


def _border(config: PhantomConfig) -> np.ndarray:
    """Transmission [H, W] in 0..1 of the round-cornered window through which the endoscope looks."""
    margin = config.border * config.height
    x = np.abs(np.arange(config.width) + 0.5 - config.width / 2)
    y = np.abs(np.arange(config.height) + 0.5 - config.height / 2)
    corner = 3.0 * margin
    dx = np.maximum(x - (config.width / 2 - margin - corner), 0.0)
    dy = np.maximum(y - (config.height / 2 - margin - corner), 0.0)
    return np.clip((corner - np.hypot(dx, dy[:, None])) / max(0.4 * margin, 1.0), 0.0, 1.0).astype(np.float32)


def phantom_sequence(config: PhantomConfig) -> Iterator[Frame]:
    """Film the patient: frames with exact pose and depth, rendered as they are asked for, a few at a time.

    Args:
        config: The patient and the endoscope.

    Yields:
        Frames `1 / fps` apart from stamp 1 s on. The depth is exact and positive everywhere but under the border.
    """
    phantom = build_phantom(config.seed, config.sections)
    window = _border(config)[..., None] if config.border > 0 else None
    mask = np.full((config.height, config.width), 255, np.uint8)
    if window is not None:
        mask[window[..., 0] < 1.0] = 0

    def expose(camera: Camera, rig: Camera, index: int, eye: int) -> tuple[np.ndarray, np.ndarray]:
        radiance, depth = radiance_and_depth(phantom, camera, rig, displacement_at(config, index / config.fps))
        image = develop(radiance, camera, config.exposure, config.auto_exposure)
        if window is not None:
            image *= window
        if config.noise > 0:
            rng = np.random.default_rng([config.seed, index, eye])
            image += np.float32(config.noise) * rng.standard_normal(image.shape, np.float32)
        return quantise(image), depth

    def film(index: int, pose: np.ndarray) -> Frame:
        camera = phantom_camera(config, pose)
        image, depth = expose(camera, camera, index, 0)
        right = None
        if config.stereo:
            right = expose(camera.beside(config.baseline), camera, index, 1)[0]
        return Frame(
            stamp_ns=FIRST_STAMP_NS + round(index * 1e9 / config.fps),
            image=image,
            camera=camera,
            right=right,
            baseline=config.baseline if config.stereo else None,
            depth=np.where(mask > 0, depth, np.float32(0.0)),
            mask=mask,
        )

    poses = phantom_poses(config)
    yield film(0, poses[0])  # alone, since it may compile
    step = cpu_threads()
    with ThreadPoolExecutor(step) as pool:
        for start in range(1, config.frames, step):
            numbers = range(start, min(start + step, config.frames))
            yield from pool.map(film, numbers, poses[numbers])
