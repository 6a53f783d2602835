"""What is trained on: a reconstructed model, the cameras that saw it, and the tissue behind it."""

import contextlib
import functools
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from endo_sim_ros.core.cameras import Camera, load_cameras, save_cameras
from endo_sim_ros.core.gaussians import GaussianModel, ModelError, load_ply, save_ply
from endo_sim_ros.learning.tasks import find_task
from endo_sim_ros.physics import ControlNodes, PhysicsConfig, build_control_nodes
from endo_sim_ros.rendering import render_depth

_CACHED = "phantom-1.ply"  # raise the number when the default scene changes
_PIECE = 0.5  # of the synthetic patient's picture, about its middle


@dataclass(frozen=True)
class Scene:
    """A model and the cameras that it was seen from; the tissue extends away from them."""

    model: GaussianModel
    cameras: tuple[Camera, ...]

    @property
    def camera(self) -> Camera:
        """The endoscope that looks at a task: as in the graph at the pose of the view in the middle, with the intrinsics of the first."""
        return self.cameras[0].at(self.cameras[len(self.cameras) // 2].pose)

    def nodes(self, config: PhysicsConfig) -> ControlNodes:
        """The tissue's control nodes at rest, m, world: those that physics_node makes of the same files.

        Raises:
            ValueError: If the model gives no control nodes, as `build_control_nodes` says.
        """
        # On the wire all cameras have the intrinsics of one.
        cameras = [self.camera.at(camera.pose) for camera in self.cameras]
        return build_control_nodes(self.model, np.stack([camera.position for camera in cameras]), config, cameras, render_depth)


def load_scene(path: str | Path | None = None) -> Scene:
    """A PLY model with the cameras.json beside it, or the folder of a model.ply; without a path a piece of the synthetic patient.

    Raises:
        ModelError: If the model cannot be read.
        ValueError: If the cameras cannot.
    """
    if path is None:
        return default_scene()
    path = Path(path)
    path = path / "model.ply" if path.is_dir() else path
    model, cameras = load_ply(path), load_cameras(path.parent / "cameras.json")
    if not cameras:
        raise ValueError(f"{path.parent / 'cameras.json'} has no camera; a task needs to know from where the tissue is seen")
    return Scene(model, tuple(cameras))


def save_scene(scene: Scene, folder: Path, task: str, seed: int = 0) -> None:
    """Write model.ply, cameras.json and parameters.yaml, which start the graph in lockstep on a task in this scene.

    Args:
        scene: What to write.
        folder: Where; it is made if need be.
        task: Name of the task.
        seed: Of the first episode.

    Raises:
        ValueError: If there is no such task, or the scene is too small for it.
    """
    kind = find_task(task)
    physics = kind.physics()
    first = kind(scene.nodes(physics), scene.camera.position)
    first.reset(0, np.random.default_rng(seed))
    changed = {name: value for name, value in asdict(physics).items() if value != getattr(PhysicsConfig(), name) and name != "device"}
    changed |= {"regions": list(first.regions())} if first.regions() else {}
    save_ply(scene.model, folder / "model.ply")
    save_cameras(list(scene.cameras), folder / "cameras.json")
    bare = {"instruments": ["none"]}  # the tool of a task is a tip that reaches every pose and is not seen
    parameters = {
        "reconstruction_node": {"mode": "lockstep", "model_file": str(folder.resolve() / "model.ply")},
        "physics_node": {"mode": "lockstep", "arm_source": "commanded", "lockstep_inputs": ["pose", "jaw"], **bare, **changed},
        "rendering_node": {"mode": "lockstep"},
        "policy": {"task": task, "scene": str(folder.resolve()), "seed": seed},
    }
    sections = {f"/**/{node}": {"ros__parameters": values} for node, values in parameters.items()}
    (folder / "parameters.yaml").write_text(yaml.safe_dump(sections, sort_keys=False))


@functools.cache
def default_scene() -> Scene:
    """The middle of the synthetic patient, 6000 Gaussians. Rendered once (some seconds), then kept in ~/.cache/endo_sim_ros."""
    from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_camera

    whole = phantom_camera(PhantomConfig(width=128, height=102))
    K = whole.K.copy()
    K[:2, :2] /= _PIECE
    camera = replace(whole, K=K)
    path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "endo_sim_ros" / _CACHED
    with contextlib.suppress(ModelError):  # there is none yet, or it was damaged
        return Scene(load_ply(path), (camera,))
    from endo_sim_ros.sequences.phantom_model import phantom_model

    model, _ = phantom_model(24_000, whole.width)
    model = model.select(np.flatnonzero(camera.sees(model.means.double().numpy())))
    with contextlib.suppress(OSError):  # of a home that cannot be written; it is rendered again next time
        save_ply(model, path)
    return Scene(model, (camera,))
