"""What is trained on: a reconstructed model, the cameras that saw it, and the tissue behind it."""

import contextlib
import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from endo_sim_ros.core.cameras import Camera, load_cameras
from endo_sim_ros.core.gaussians import GaussianModel, ModelError, load_ply, save_ply
from endo_sim_ros.physics import ControlNodes, PhysicsConfig, build_control_nodes
from endo_sim_ros.rendering import middle_depth, render_depth

PATIENT = "phantom:"
"""How the name of a synthetic patient begins; its seed follows."""

_CACHED, _VERSION = "phantom-{version}-{seed}.ply", "3"  # raise the version when the scenes change
_KEPT = 16  # control nodes of a scene: of each task, and of some that differ in their physics
_NEARER = 2.0  # how much nearer than in the middle of the picture tissue may be at its sides
_PIECE = 0.5  # of the synthetic patient's picture, about its middle


@dataclass(frozen=True)
class Scene:
    """A model and the cameras that it was seen from; the tissue extends away from them."""

    model: GaussianModel
    cameras: tuple[Camera, ...]
    beyond: GaussianModel | None = None  # what an endoscope that moves sees past the edge of the model; no tool acts there

    @functools.cached_property
    def whole(self) -> GaussianModel:
        """The model, and behind it what lies beyond its edge."""
        return self.model if self.beyond is None else _joined(self.model, self.beyond)

    def seen_within(self, right: float, around: float) -> GaussianModel:
        """The model, and of what lies beyond its edge that which is seen from up to ``right`` m to the right of the endoscope, where tissue
        is moved by up to ``around`` m."""
        if self.beyond is None or not right + around:
            return self.model
        camera, pixels = self.camera, _NEARER * self.camera.K[0, 0] / self.depth  # pixels for each m
        margin, wider = round(pixels * around), round(pixels * (2 * around + right))
        K = camera.K.copy()
        K[:2, 2] += margin
        wide = replace(camera, K=K, width=camera.width + wider, height=camera.height + 2 * margin)
        return _joined(self.model, self.beyond.select(np.flatnonzero(wide.sees(self.beyond.means.double().numpy()))))

    @property
    def camera(self) -> Camera:
        """The endoscope that looks at a task: as in the graph at the pose of the view in the middle, with the intrinsics of the first."""
        return self.cameras[0].at(self.cameras[len(self.cameras) // 2].pose)

    @functools.cached_property
    def depth(self) -> float:
        """Depth of the tissue in the middle of the endoscope's picture, m, world.

        Raises:
            ValueError: If there is none.
        """
        depth = middle_depth(render_depth(self.model, self.camera))
        if depth is None:
            raise ValueError("the endoscope sees no tissue in the middle of its picture; check the poses in cameras.json")
        return depth

    def nodes(self, config: PhysicsConfig) -> ControlNodes:
        """The tissue's control nodes at rest, m, world: those that physics_node makes of the same files. Who asks for the same ones again
        shares their arrays.

        Raises:
            ValueError: If the model gives no control nodes, as `build_control_nodes` says.
        """
        if config in self._nodes:
            return self._nodes[config]
        # On the wire all cameras have the intrinsics of one.
        cameras = [self.camera.at(camera.pose) for camera in self.cameras]
        nodes = build_control_nodes(self.model, np.stack([camera.position for camera in cameras]), config, cameras, render_depth)
        if not config.motion.file:  # which others may change
            while len(self._nodes) >= _KEPT:
                del self._nodes[next(iter(self._nodes))]
            self._nodes[config] = nodes
        return nodes

    @functools.cached_property
    def _nodes(self) -> dict[PhysicsConfig, ControlNodes]:
        """Those that were asked for last."""
        return {}


def _joined(model: GaussianModel, other: GaussianModel) -> GaussianModel:
    """A model, and behind its Gaussians those of another."""
    more = other.tensors()
    return replace(model, **{name: torch.cat([tensor, more[name]]) for name, tensor in model.tensors().items()})


def load_scene(path: str | Path | None = None) -> Scene:
    """A PLY model with the cameras.json beside it, or the folder of a model.ply, or ``phantom:SEED``, a piece of a synthetic patient.

    Without a path it is that of ``phantom:0``.

    Raises:
        ModelError: If the model cannot be read.
        ValueError: If the cameras cannot, or a seed is no number.
    """
    place = _found(path)
    if isinstance(place, int):
        return patient_scene(place)
    model, cameras = load_ply(place), load_cameras(place.parent / "cameras.json")
    if not cameras:
        raise ValueError(f"{place.parent / 'cameras.json'} has no camera; a task needs to know from where the tissue is seen")
    return Scene(model, tuple(cameras))


def load_scenes(paths: Sequence[str | Path]) -> list[Scene]:
    """Several scenes, each as `load_scene` takes it.

    Raises:
        ModelError, ValueError: As `load_scene` does, and if there is none, or one is given twice.
    """
    if not paths:
        raise ValueError("there is no scene; give one or more, such as phantom:0")
    found: dict[int | Path, str | Path] = {}
    for path in paths:
        place = _found(path)
        place = place if isinstance(place, int) else place.resolve()
        if place in found:
            raise ValueError(f"{path}: the same scene as {found[place]}; give each once")
        found[place] = path
    return [load_scene(path) for path in paths]


def _found(path: str | Path | None) -> int | Path:
    """The seed of a synthetic patient, or the file of a model."""
    if path is None or str(path).startswith(PATIENT):
        seed = "0" if path is None else str(path).removeprefix(PATIENT)
        if not seed.isdecimal():
            raise ValueError(f"{path}: the seed of a synthetic patient is a number, as in {PATIENT}1")
        return int(seed)
    path = Path(path)
    return path / "model.ply" if path.is_dir() else path


@functools.cache
def patient_scene(seed: int = 0) -> Scene:
    """The middle of a synthetic patient, 6000 Gaussians, and 18 000 beyond its edge. Rendered once (some seconds), then kept in
    ~/.cache/endo_sim_ros."""
    from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_camera

    picture = phantom_camera(PhantomConfig(width=128, height=102))
    K = picture.K.copy()
    K[:2, :2] /= _PIECE
    camera = replace(picture, K=K)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "endo_sim_ros"
    path = cache / _CACHED.format(version=_VERSION, seed=seed)
    try:
        whole = load_ply(path)
    except (ModelError, OSError):  # there is none yet, it was damaged, or the home is that of others
        from endo_sim_ros.sequences.phantom_model import phantom_model

        whole, _ = phantom_model(24_000, picture.width, seed)
        with contextlib.suppress(OSError):  # of a home that cannot be written; it is rendered again next time
            save_ply(whole, path)
    middle = camera.sees(whole.means.double().numpy())
    return Scene(whole.select(np.flatnonzero(middle)), (camera,), whole.select(np.flatnonzero(~middle)))
