"""The viewer on a simulation in the same process: a model file and a browser are all it needs."""

import dataclasses
import logging
import time
from pathlib import Path

import numpy as np

from endo_sim_ros.core.cameras import Camera, load_cameras, look_at, rigid_pose
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.gaussians import GaussianModel, load_ply
from endo_sim_ros.core.motion import MOTION_FILE
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.instruments import load_arm, place_arm
from endo_sim_ros.instruments.aiming import AHEAD
from endo_sim_ros.instruments.urdf_reader import load_shape
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig, middle_depth, render_depth
from endo_sim_ros.viewer.config import ViewerConfig
from endo_sim_ros.viewer.posed_tool import PosedTool
from endo_sim_ros.viewer.tool_marks import Tool
from endo_sim_ros.viewer.viewer import PARAMETERS, Viewer, plain_camera

_logger = logging.getLogger(__name__)
_HAND = "mouse"  # name of the tool
_WINDOW = 1.0  # s over which the real-time factor is measured


class Standalone:
    """Tissue that follows the clock, and the page on which it is seen and touched.

    Args:
        model: The Gaussians.
        cameras: From where they were seen; the one in the middle is the endoscope of the page.
        physics: Parameters of the tissue.
        config: Parameters of the page.
        instrument: Name of the tool that the mouse moves, or path of its file, after an @ the path of a URDF that has its shape; empty =
            a bare tip.

    Raises:
        ConfigError: If there is no such tool, its URDF cannot be used, or the page cannot be served.
    """

    def __init__(self, model: GaussianModel, cameras: list[Camera], physics: PhysicsConfig, config: ViewerConfig, instrument: str = ""):
        self.model, self._physics = model, physics
        self._camera = cameras[len(cameras) // 2]
        self._cameras = cameras
        self._tool = self._make_tool(instrument) if instrument else None
        self.simulation = self._simulate(physics)
        self._pose: np.ndarray | None = None
        self._faults = self._slips = self._tears = 0
        self._real_time_factor = 1.0
        self._endoscope_dirty = True
        self.viewer = Viewer(config, self)
        self._show_model()

    def _make_tool(self, name: str) -> PosedTool | None:
        """The tool on an arm that stands where a graph's PSM1 does; None where such an arm does not reach the tissue."""
        arm, shape = load_arm("PSM", name.partition("@")[0]), load_shape(name)
        depth = middle_depth(render_depth(self.model, self._camera))
        try:
            place = place_arm("PSM1", arm, self._camera, depth or 0.0)
        except ConfigError as error:
            _logger.warning("the mouse moves a bare tip: %s", error)
            return None
        return PosedTool(arm, shape, place, pick_device(self._physics.device))

    def _simulate(self, physics: PhysicsConfig) -> TissueSimulation:
        viewpoint = np.stack([camera.position for camera in self._cameras])
        simulation = TissueSimulation(self.model, viewpoint, physics, self._cameras, render_depth)
        if self._tool is not None:
            simulation.set_instrument(_HAND, self._tool.capsules)
        return simulation

    def _show_model(self) -> None:
        rest = self.simulation.nodes.rest
        # Holes stay black: the mouse takes the camera to where no endoscope goes, and a model is seen best before black.
        self._renderer = DeformableRenderer(self.model, rest, RenderingConfig(device=self._physics.device, background=0.0))
        self.viewer.show_model(self._renderer, rest, self._camera)
        if self._tool is not None:
            self.viewer.show_instruments(self._tool.drawn())
        self._show_parameters()
        self._restart_clock()
        self._show()

    def _show_parameters(self) -> None:
        self.viewer.show_parameters({name: getattr(self._physics, name) for name in PARAMETERS})

    # ---------------------------------------------------------------- actions

    def aim(self, point: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, float]:
        """As `Actions` has it: an instrument comes straight from its remote centre."""
        if self._tool is not None:
            return self._tool.aim(point), AHEAD
        return rigid_pose(axes, point), 0.0

    def hold(self, pose: np.ndarray, closed: bool) -> None:
        """Move the tool to a pose [4, 4], m, world, and close its jaw; say so where nothing can be held."""
        if self._tool is None and not closed:
            return
        if self._move(pose, closed):
            return
        missed = "it is fixed, or further away than the hold radius" if self._tool is None else "nothing is between the jaws, or it slips"
        self.viewer.notify(f"nothing here can be held: {missed}")
        self.viewer.release()

    def let_go(self) -> None:
        """Open the jaw."""
        if self._pose is not None:
            self._move(self._pose, False)
        self._pose = None

    def _move(self, pose: np.ndarray, closed: bool) -> bool:
        """Move the tool, and close or open its jaw; returns whether that holds what it should."""
        links = None
        if self._tool is not None:
            links, pose = self._tool.move(pose, closed), self._tool.pose
            self.viewer.show_instruments(self._tool.drawn())
            self._endoscope_dirty = True
        held = self.simulation.set_grasp(_HAND, pose, closed, links)
        if held and closed:
            self._pose = pose
        return held

    def set_parameters(self, values: dict[str, float]) -> None:
        """Rebuild the simulation with new values, SI units, and go on from its state; keep the old one if they are refused."""
        try:
            physics = dataclasses.replace(self._physics, **values)
            simulation = self._simulate(physics)
        except ValueError as error:
            self.viewer.notify(str(error))
            self._show_parameters()
            return
        continued = simulation.continue_from(self.simulation)
        if not continued:
            self.viewer.release()
        self.simulation, self._physics = simulation, physics
        self._faults, self._slips, self._tears = simulation.faults, simulation.slips, simulation.tears
        if not continued:
            self._show_model()
        self._show_parameters()
        self._restart_clock()

    def reset(self) -> None:
        """Return the tissue to rest."""
        self.simulation.reset()
        if self._tool is not None:
            self._tool.return_to_start()
            self.viewer.show_instruments(self._tool.drawn())
        self._restart_clock()
        self._show()

    def pause(self, paused: bool) -> None:
        """Stop time, or let it go on."""
        self.viewer.show_text(*self._text(), paused=paused)
        self._restart_clock()

    def step(self) -> None:
        """Advance one step while time stands still."""
        if self.viewer.paused:
            self._step()

    # ------------------------------------------------------------------- time

    def run(self) -> None:
        """Until interrupted."""
        try:
            while True:
                self.turn()
        finally:
            self.viewer.stop()

    def turn(self) -> None:
        """Take what users did and, when it is time for it, a step."""
        try:
            self.viewer.update()
        except Exception as error:  # one user's mishap must not end the page for all
            _logger.exception("the page failed")
            self.viewer.notify(f"{type(error).__name__}: {error}")
        now = time.monotonic()
        if self.viewer.paused or now < self._due:
            time.sleep(min(0.005, max(self._due - now, 0.001)))
            return
        duration = self.simulation.step_duration
        self._due = max(self._due + duration, now - duration)  # what cannot be kept up with is left out
        self._step()
        self._measure(time.monotonic())

    def _step(self) -> None:
        begun, simulation = time.monotonic(), self.simulation
        simulation.step()
        if simulation.faults > self._faults:
            self.viewer.notify(simulation.last_fault)
        if simulation.slips > self._slips:
            self.viewer.notify("the tissue slipped out of the jaw")
        if simulation.tears > self._tears:
            self.viewer.notify(simulation.last_tear)
        self._faults, self._slips, self._tears = simulation.faults, simulation.slips, simulation.tears
        self._show(time.monotonic() - begun)

    def _show(self, age: float = 0.0) -> None:
        state = self.simulation.state()
        self._renderer.cut(self.simulation.cuts)
        force, _ = self.simulation.reaction(_HAND)
        works_at = None if self._pose is None else self._pose[:3, 3] if self._tool is None else self._tool.works_at
        tools = {} if works_at is None else {_HAND: Tool(works_at, -force)}
        viewer, moved = self.viewer, self.viewer.show_state(state.positions, state.F, age)
        viewer.show_tools(tools, _HAND)
        viewer.show_text(*self._text())
        self._endoscope_dirty |= moved
        if viewer.wants_endoscope and self._endoscope_dirty:
            self._endoscope_dirty = False
            drawn = None if self._tool is None else self._tool.drawn()
            seen = self._renderer.views([self._camera], state.positions, state.F, depth=False, instruments=drawn)[0]
            viewer.show_endoscope(seen.image, self._camera)

    def _restart_clock(self) -> None:
        self._due = time.monotonic()
        self._window = self._due, self.simulation.time

    def _measure(self, now: float) -> None:
        if now - self._window[0] > _WINDOW:
            self._real_time_factor = (self.simulation.time - self._window[1]) / (now - self._window[0])
            self._window = now, self.simulation.time

    def _text(self) -> list[str]:
        pace = "paused" if self.viewer.paused else f"real time × {self._real_time_factor:.2f}"
        return [f"{len(self.model)} Gaussians, {len(self.simulation.nodes.rest)} nodes", f"{self.simulation.time:.1f} s, {pace}"]


def view(path: Path, physics: PhysicsConfig, config: ViewerConfig, instrument: str, moves: bool = True) -> None:
    """Serve the page on a PLY model, seen by the cameras in the cameras.json beside it, else from the world's origin.

    Args:
        path: The model.
        physics, config, instrument: As for `Standalone`.
        moves: Whether the tissue moves by itself as the motion.npz beside the model has it; one that cannot be used is told, and left out.

    Raises:
        ModelError: If the model cannot be read.
        ValueError: If the cameras or the options cannot be used; ConfigError if the page cannot be served.
    """
    model = load_ply(path)
    if moves:
        physics = moving_as_found(path, model, physics)
    beside = path.parent / "cameras.json"
    page = Standalone(model, load_cameras(beside) if beside.is_file() else [camera_at_origin(model)], physics, config, instrument)
    print(f"open {page.viewer.url} in a browser; Ctrl-C ends", flush=True)
    page.run()


def moving_as_found(path: Path, model: GaussianModel, physics: PhysicsConfig) -> PhysicsConfig:
    """The physics with the motion that was found with a model, of this path, if there is one; one that cannot be used is logged."""
    file = path.parent / MOTION_FILE
    try:
        return physics.replaced({"motion": {"file": str(file), **TissueMotion.load(file, model).parameters}}) if file.is_file() else physics
    except ValueError as error:
        _logger.warning("the tissue does not move by itself: %s", error)
        return physics


def camera_at_origin(model: GaussianModel) -> Camera:
    """A camera at the world's origin that looks at the model."""
    target = model.means.median(0).values.double().numpy()
    ahead = np.linalg.norm(target[::2]) > 0.1 * abs(target[1])
    return plain_camera(look_at(np.zeros(3), target, np.array([0.0, -1, 0] if ahead else [0.0, 0, 1])))
