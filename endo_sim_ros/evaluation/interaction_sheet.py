"""One picture of what tools do to a model: poked, pulled, let go, grasped and cut."""

import dataclasses
import logging
from pathlib import Path

import numpy as np
from rich.progress import track

from endo_sim_ros.core import drawing
from endo_sim_ros.core.cameras import Camera, load_cameras
from endo_sim_ros.core.config import ConfigError, options
from endo_sim_ros.core.gaussians import load_ply
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig, render_depth

log = logging.getLogger(__name__)

_STEPS = 25  # of each touch

Touched = tuple[str, np.ndarray, np.ndarray]
"""What is written below a picture, where the tip is [3], m, world, and the force on the tissue [3], N, world."""


def draw_touches(model_path: Path, out: Path, config: PhysicsConfig) -> None:
    """Touch a model in the middle of its middle camera's picture, in five ways, and write a sheet of what that camera sees.

    Args:
        model_path: PLY file, with the cameras.json that the reconstruction saves beside it.
        out: PNG to write.
        config: Of the tissue; lengths of tools follow the size of what is seen.

    Raises:
        ValueError: If there is no camera, or nothing in the middle of its picture, or its scale is wrong, or this cannot be written.
    """
    drawing.require_writable(out)
    if config.kinematics != "rest":
        raise ValueError(f"tissue with kinematics {config.kinematics} cannot be cut, as the picture shows; leave it at rest")
    model, cameras = load_ply(model_path), load_cameras(model_path.parent / "cameras.json")
    if not cameras:
        raise ValueError(f"{model_path.parent / 'cameras.json'}: there is no camera in it")
    camera = cameras[len(cameras) // 2]
    views = np.stack([each.position for each in cameras])
    picture, depth = DeformableRenderer(model, None, RenderingConfig(device=config.device)).render(camera)
    middle = camera.backproject(depth)[depth.shape[0] // 2, depth.shape[1] // 2]
    if not np.isfinite(middle).all() or depth[depth.shape[0] // 2, depth.shape[1] // 2] <= 0:
        raise ValueError(f"{model_path}: its middle camera sees no tissue in the middle of its picture")
    width = float(depth[depth > 0].mean()) * camera.width / camera.K[0, 0]
    size = 0.12 * width  # m, about an eighth of what is seen
    (longest,) = (option.range.maximum for option in options(PhysicsConfig) if option.name == "blade_length" and option.range)
    blade = min(max(4 * size, 2 * config.thickness), longest)
    try:
        config = dataclasses.replace(config, force_radius=0.5 * size, blade_length=blade)
        rod = dataclasses.replace(config, contact_radius=0.5 * size, contact_length=4 * size)
    except ConfigError:  # no such tool is allowed
        seen = f"{model_path}: its middle camera sees {width:.3g} m of tissue, an endoscope some centimetres"
        raise ValueError(f"{seen}; correct the scale of the poses") from None
    pictures = [("at rest", picture)]
    for touch in track((_poke, _pull, _let_go, _grasp, _cut), description="touching the tissue"):
        simulation = TissueSimulation(model, views, rod if touch is _poke else config, cameras, render_depth)
        renderer = DeformableRenderer(model, simulation.nodes.rest, RenderingConfig(device=config.device))
        text, tip, force = touch(simulation, camera, middle, size)
        renderer.cut(simulation.cuts)
        if simulation.tears:
            text += ", torn"
            log.warning("%s: %s", text, simulation.last_tear)
        state = simulation.state()
        image, _ = renderer.render(camera, state.positions, state.F)
        pictures.append((text, drawing.draw_force(image, camera, tip, force, size / max(np.linalg.norm(force), 1e-9))))
        if simulation.faults:
            log.warning(simulation.last_fault)
    drawing.write_png(out, drawing.sheet(pictures, columns=3))
    print(out)


def _tool(camera: Camera, tip: np.ndarray, turn: float = 0.0) -> np.ndarray:
    """Pose [4, 4] of a tool that looks along the camera's axis, turned about it."""
    pose = camera.pose.copy()
    c, s = np.cos(turn), np.sin(turn)
    pose[:3, :2] = pose[:3, :2] @ np.array([[c, -s], [s, c]])
    pose[:3, 3] = tip
    return pose


def _poke(simulation: TissueSimulation, camera: Camera, middle: np.ndarray, size: float) -> Touched:
    ahead = camera.pose[:3, 2]
    for step in range(_STEPS):
        tip = middle + (min(step / (_STEPS - 8), 1) * size - simulation.contact_radius) * ahead
        simulation.set_grasp("tool", _tool(camera, tip), False)
        simulation.step()
    force = -simulation.reaction("tool")[0]
    return f"poked {1e3 * size:.0f} mm deep by a rod: {np.linalg.norm(force):.2f} N", tip, force


def _pull(simulation: TissueSimulation, camera: Camera, middle: np.ndarray, size: float) -> Touched:
    """Pull, ever harder, until the tissue has moved by `size`."""
    direction, force = -camera.pose[:3, 2] + 0.7 * camera.pose[:3, 0], 0.02
    for _ in range(4 * _STEPS):
        simulation.set_wrench("tool", middle, force * direction)
        simulation.step()
        held = simulation.held_nodes("tool")
        moved = (simulation.solver.displacements()[held]).mean(0) if len(held) else np.zeros(3)
        if np.linalg.norm(moved) > size:
            break
        force *= 1.1
    return f"pulled by {np.linalg.norm(force * direction):.2f} N", middle + moved, force * direction


def _let_go(simulation: TissueSimulation, camera: Camera, middle: np.ndarray, size: float) -> Touched:
    _pull(simulation, camera, middle, size)
    simulation.set_wrench("tool", middle, np.zeros(3))
    for _ in range(_STEPS):
        simulation.step()
    left = np.linalg.norm(simulation.solver.displacements(), axis=1).max()
    seconds = _STEPS * simulation.step_duration
    return f"let go: {1e3 * left:.2f} mm from rest after {seconds:g} s", middle, np.zeros(3)


def _grasp(simulation: TissueSimulation, camera: Camera, middle: np.ndarray, size: float) -> Touched:
    simulation.set_grasp("tool", _tool(camera, middle), True)
    for step in range(_STEPS):
        share = step / (_STEPS - 1)
        tip = middle + share * size * (-camera.pose[:3, 2] - 0.5 * camera.pose[:3, 1])
        simulation.set_grasp("tool", _tool(camera, tip, 0.8 * share), True)
        simulation.step()
    force = -simulation.reaction("tool")[0]
    return f"grasped, lifted and turned: {np.linalg.norm(force):.2f} N", tip, force


def _cut(simulation: TissueSimulation, camera: Camera, middle: np.ndarray, size: float) -> Touched:
    """Cut right through, across the picture, then pull the edges apart."""
    right, down, ahead = camera.pose[:3, :3].T
    for step in range(2 * _STEPS):
        along = (step / (_STEPS - 0.5) - 1) * 1.5 * size
        simulation.set_cut("tool", _tool(camera, middle + along * down + simulation.config.blade_length / 2 * ahead), True)
    simulation.set_cut("tool", _tool(camera, middle), False)
    skin = simulation.nodes.rest[simulation.nodes.is_skin & ~simulation.nodes.pinned]
    if not len(skin):
        raise ValueError(f"all {len(simulation.nodes)} nodes are pinned; raise node_count, or set pin_rim to false")
    held = {}
    for side in (-1, 1):
        for along in (-0.7, 0.0, 0.7):
            wanted = middle + size * (0.6 * side * right + along * down)
            held[f"{side} {along}"] = side, skin[np.linalg.norm(skin - wanted, axis=1).argmin()]
    for step in range(_STEPS + 1):
        for tool, (side, tip) in held.items():
            simulation.set_grasp(tool, _tool(camera, tip + side * right * 0.35 * size * step / _STEPS), True)
        simulation.step()
    return f"cut over {3e3 * size:.0f} mm, its edges held apart", middle, np.zeros(3)
