"""The page: what browsers show, and what users do there. It knows no ROS; what drives it is behind `Actions`."""

import errno
import logging
import queue
import socket
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.drawing import draw_force
from endo_sim_ros.instruments.drawing import PosedInstruments
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.rendering import DeformableRenderer
from endo_sim_ros.viewer.browser import CENTIMETRES, ENDOSCOPE, Browser, Pointer
from endo_sim_ros.viewer.config import ViewerConfig
from endo_sim_ros.viewer.grasp import Grasp
from endo_sim_ros.viewer.sliders import SLIDERS, Sliders
from endo_sim_ros.viewer.stiffness import StiffnessColors
from endo_sim_ros.viewer.stress import StressColors
from endo_sim_ros.viewer.tool_marks import ARROW, Tool, ToolMarks

_TEXT_EVERY = 0.5  # s
_PANEL_WIDTH = 270  # pixels
_NOTICE_FOR = 8.0  # s that a notice stays
_TRAVEL = 0.8  # share of the physics' travel that the mouse may pull; tissue slips out of a jaw at 0.9
_FOCAL = 0.85  # focal length of a camera that nothing is known of, in image widths


# Those of physics that the page needs to know.
PARAMETERS = (
    *(slider.parameter for slider in SLIDERS), "poisson_ratio", "material", "stiffening", "stiffening_limit", "regions", "travel",
)  # fmt: skip


class Actions(Protocol):
    """What a user can do to the tissue."""

    def aim(self, point: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, float]:
        """Pose of the tip [4, 4], m, world, with which the tool works at a point of the tissue [3], and how far ahead of it the tool comes
        from, m. A bare tip has the axes [3, 3] of the view."""
        ...

    def hold(self, pose: np.ndarray, closed: bool) -> None:
        """A tip is at this pose [4, 4], m, world, and its jaw closed or not; again and again, after `let_go` on its way back."""

    def let_go(self) -> None:
        """The jaw opens."""

    def set_parameters(self, values: dict[str, float]) -> None:
        """Parameters of the physics have new values, SI units."""

    def reset(self) -> None:
        """Tissue back to rest."""

    def pause(self, paused: bool) -> None:
        """Time stands still, or goes on."""

    def step(self) -> None:
        """One step while time stands still."""


class Viewer:
    """Serves the page to any number of browsers.

    Everything happens in the thread that calls :meth:`update`, several times per picture: what users do waits in a queue
    until then. Of several users, one at a time holds tissue.

    Args:
        config: Parameters.
        actions: Takes what users do.

    Raises:
        ConfigError: If viser is not installed or the page cannot be served at that address.
    """

    def __init__(self, config: ViewerConfig, actions: Actions):
        self.config = config
        self.actions = actions
        self._events: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.browsers: dict[int, Browser] = {}
        self.renderer: DeformableRenderer | None = None
        self.camera: Camera | None = None  # of the endoscope
        self.endoscope: tuple[np.ndarray, Camera] | None = None  # its newest picture
        self.state: tuple[np.ndarray, np.ndarray] | None = None  # positions [M, 3] and F [M, 3, 3] of the nodes, None at rest
        self.tools: dict[str, Tool] = {}
        self.instruments: PosedInstruments | None = None
        self._node_size = 0.0  # cm
        self._begun = 0.0  # when the step to that state began
        self._dirty, self._drawn = False, 0.0
        self.grasp: Grasp | None = None
        self._leaving: Grasp | None = None  # the one before, whose jaw is on its way back
        self._holder, self._force = 0, np.zeros(3)  # who holds, and the force on the tissue, N, world
        self._plane: tuple[np.ndarray, np.ndarray, float] = np.zeros(3), np.zeros(3), 0.0
        self._asked: float | None = None  # when the mouse moved; its pull has not been seen yet
        self.latency, self.pictures_per_second = 0.0, 0.0  # s; Hz
        self._pictures, self._texted, self._updated = 0, 0.0, time.monotonic()
        self._parameters: dict[str, Any] = {name: getattr(PhysicsConfig(), name) for name in PARAMETERS}
        self.stress_colors = StressColors(self._parameters, self.notify)
        self.stiffness_colors = StiffnessColors(self.stress_colors)
        self.paused = False
        self._lines: tuple[str, ...] = ()
        self.notice, self._notice_until = "", 0.0
        self._server = serve(config)
        self._build_page()

    @property
    def url(self) -> str:
        """Address of the page, as a browser on this machine reaches it."""
        host = "localhost" if self.config.host in ("0.0.0.0", "::") else self.config.host
        return f"http://{host}:{self._server.get_port()}"

    @property
    def holding(self) -> bool:
        """Whether somebody holds tissue."""
        return self.grasp is not None

    # ----------------------------------------------------------- what is shown

    def show_model(self, renderer: DeformableRenderer, node_rest: np.ndarray | None, camera: Camera) -> None:
        """A new model, at rest, and the camera from which pages look at it first; or the same one with other nodes."""
        old = self.renderer
        same = old is not None and torch.equal(old.model.means, renderer.model.means)
        self.renderer, self.state, self.camera = renderer, None, camera
        self.stress_colors.set_nodes(node_rest)
        self.stiffness_colors.set_nodes(node_rest)
        self.release()
        means = renderer.model.means.cpu().numpy()
        if node_rest is not None and len(node_rest) > 1:
            extent = np.percentile(node_rest, 95, 0) - np.percentile(node_rest, 5, 0)
            self._node_size = 0.4 * CENTIMETRES * float(np.sort(extent)[1:].prod() / len(node_rest)) ** 0.5
        pose, target = camera.pose, camera.position + camera.pose[:3, 2] * np.median((means - camera.position) @ camera.pose[:3, 2])
        self._server.scene.set_up_direction(-pose[:3, 1])
        start = self._server.initial_camera
        start.position, start.look_at, start.up = CENTIMETRES * camera.position, CENTIMETRES * target, -pose[:3, 1]
        start.fov = 2 * np.arctan(camera.height / 2 / camera.K[1, 1])
        for browser in self.browsers.values():
            if not same:
                self._show_model_in(browser)
        self._dirty = True

    def show_instruments(self, instruments: PosedInstruments | None) -> None:
        """Show instruments in the pictures that are rendered here, not in those that browsers draw."""
        self.instruments, self._dirty = instruments, True

    def show_state(self, positions: np.ndarray, F: np.ndarray, age: float = 0.0) -> bool:
        """Show nodes at positions [M, 3] (m) with F [M, 3, 3], whose step began ``age`` seconds ago; returns whether they moved."""
        old = self.state
        moved = old is None or not (np.array_equal(positions, old[0]) and np.array_equal(F, old[1]))
        self.state, self._begun = (positions, F), time.monotonic() - age
        self._dirty |= moved
        return moved

    def show_endoscope(self, image: np.ndarray, camera: Camera) -> None:
        """The endoscope's picture [H, W, 3] uint8 and its camera."""
        self.endoscope = image, camera
        self._dirty |= self.wants_endoscope

    @property
    def wants_endoscope(self) -> bool:
        """Whether anybody looks through the endoscope."""
        return any(browser.view == ENDOSCOPE for browser in self.browsers.values())

    def show_tools(self, tools: dict[str, Tool], mine: str) -> None:
        """All tools by name, and the name of that which the mouse moves."""
        self.tools, self._force = tools, tools[mine].force if mine in tools else np.zeros(3)

    def show_parameters(self, values: dict[str, Any]) -> None:
        """The physics' parameters as they are."""
        if (known := self._parameters | values) != self._parameters:
            self._parameters = known
            self.stress_colors.set_parameters(known)
            self.stiffness_colors.renew()
            self._dirty = True
        self.sliders.show(values)

    def show_stiffness(self, positions: np.ndarray, young_modulus: np.ndarray, known: np.ndarray) -> None:
        """What was identified of the stiffness: nodes at rest [K, 3], m, world, their moduli [K], Pa, and where these are known [K]."""
        self.stiffness_colors.show(positions, young_modulus, known)
        self._dirty = True

    def show_text(self, *lines: str, paused: bool | None = None) -> None:
        """What there is to say about the simulation."""
        self._lines = lines
        if paused is not None and paused != self.paused:
            self.paused = paused
            self._play.label = "play" if paused else "pause"

    def notify(self, text: str) -> None:
        """Tell all users something for a while."""
        self.notice, self._notice_until = text, time.monotonic() + _NOTICE_FOR

    # -------------------------------------------------------- what users do

    def post(self, event: Callable[[], None]) -> None:
        """Have something done by the next `update`, from any thread."""
        self._events.put(event)

    def point(self, pointer: Pointer) -> None:
        """The mouse takes hold of tissue, moves or lets go."""
        browser = self.browsers.get(pointer.client)
        if pointer.phase == "end" or browser is None:
            if self.grasp is not None and pointer.client == self._holder:
                self.release()
            return
        if pointer.phase == "start" and self.grasp is None:
            self._take_hold(browser, pointer)
        if self.grasp is None or pointer.client != self._holder:
            return
        origin, ray, _ = browser.ray(*pointer.at)
        point, normal, height = self._plane
        if pointer.lifts:  # up on the screen is towards the user
            self.grasp.aim(-normal * height * (pointer.began_at[1] - pointer.at[1]))
        elif ray @ normal > 1e-6:
            self.grasp.aim(origin + ray * ((point - origin) @ normal / (ray @ normal)) - point)
        if self._asked is None:
            self._asked = time.monotonic()

    def _take_hold(self, browser: Browser, pointer: Pointer) -> None:
        point = self.pick(browser, *pointer.began_at)
        if point is None:
            return
        origin, _, camera = browser.ray(*pointer.began_at)
        pose, ahead = self.actions.aim(point, camera.pose[:3, :3])
        longest_pull = _TRAVEL * self._parameters["travel"]
        self.grasp, self._leaving = Grasp(pose, self.config.max_force, self.config.max_speed, longest_pull, ahead), None
        self._holder, self._force = pointer.client, np.zeros(3)
        depth = (point - origin) @ camera.pose[:3, 2]
        self._plane = point, camera.pose[:3, 2], depth * camera.height / camera.K[1, 1]  # the last: height of the view there

    def pick(self, browser: Browser, x: float, y: float) -> np.ndarray | None:
        """Point of the tissue [3], m, world, seen at a place in a browser's picture (0 to 1); None where there is none."""
        if self.renderer is None:
            return None
        _, _, camera = browser.ray(x, y)
        K, half = camera.K.copy(), 8  # a picture of a few pixels around that place
        K[:2, 2] += half - np.array([x * camera.width, y * camera.height])
        window = Camera(K, 2 * half, 2 * half, camera.pose)
        depth = self.renderer.render(window, *(self.state or ()))[1]
        points = window.backproject(depth)[half - 1 : half + 1, half - 1 : half + 1].reshape(-1, 3)
        seen = depth[half - 1 : half + 1, half - 1 : half + 1].reshape(-1) > 0
        return points[seen].mean(0) if seen.any() else None

    def release(self) -> None:
        """Let go of the tissue."""
        if self.grasp is not None:
            self.grasp, self._leaving, self._asked = None, self.grasp, None
            self.actions.let_go()

    def reset(self) -> None:
        """Let go, and bring the tissue back to rest."""
        self.release()
        self._leaving = None  # an arm that is back at its start stays there
        self.actions.reset()

    # ----------------------------------------------------------------- drawing

    def update(self) -> None:
        """Act on what users did, and send pictures that are due."""
        while not self._events.empty():
            self._events.get()()
        now = time.monotonic()
        if self.grasp is not None:
            pose = self.grasp.advance(now - self._updated, self.grasp.resistance(self._force))
            self.actions.hold(pose, self.grasp.closed)
        elif self._leaving is not None:
            self._leaving = self._leaving if self._leaving.withdraw(now - self._updated) else None
            if self._leaving is not None:
                self.actions.hold(self._leaving.pose, False)
        self._updated = now
        if wanted := self.sliders.take(now):
            self.actions.set_parameters(wanted)
        if now - self._drawn >= 1 / self.config.rate and self.renderer is not None:
            self._draw(now)
        if now - self._texted >= _TEXT_EVERY:
            self._write_text(now)

    def _draw(self, now: float) -> None:
        self._drawn, dirty, self._dirty = now, self._dirty, False
        self.marks.draw(self.tools)
        splats = stress = None
        for browser in self.browsers.values():
            if dirty and browser.wants_splats:
                splats = splats or self.splats()
                browser.show_splats(*splats)
            if dirty and browser.wants_nodes and self.state is not None:
                if browser.wants_stress and stress is None:
                    stress = self.stress_colors(self.state[1])
                colors = self.stiffness_colors(len(self.state[0])) if browser.wants_stiffness else None
                browser.show_nodes(self.state[0], stress if browser.wants_stress else colors, self._node_size)
            browser.show_picture(self._render, self.endoscope, self._tools_on, dirty)
        self._pictures += dirty
        if self._asked is not None and self._begun >= self._asked:
            if dirty:  # else the tissue cannot follow
                self.latency += (0.2 if self.latency else 1.0) * (time.monotonic() - self._asked - self.latency)
            self._asked = None

    def splats(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The Gaussians as they are now, as `Browser.show_splats` takes them."""
        assert self.renderer is not None  # nothing is drawn before there is a model
        model = self.renderer.model
        if self.state is None:
            means, covars = model.means, model.covariances
        else:
            means, covars = self.renderer.deform(*self.state)
            model = self.renderer.bared(model, self.state[1])
        rgb, opacity = ((values * 255).byte().cpu().numpy() for values in (model.base_colors, model.opacities[:, None]))
        return (CENTIMETRES * means).cpu().numpy(), (CENTIMETRES**2 * covars).cpu().numpy(), rgb, opacity

    def _tools_on(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        """A picture with the tools' forces."""
        for tool in self.tools.values():
            image = draw_force(image, camera, tool.position, tool.force, ARROW / CENTIMETRES)
        return image

    def _write_text(self, now: float) -> None:
        elapsed, self._texted = now - self._texted, now
        self.pictures_per_second = self._pictures / elapsed if elapsed < 10 else 0.0
        self._pictures = 0
        lines = list(self._lines)
        numbers = f"{self.pictures_per_second:.0f} pictures/s"
        if self.latency:
            numbers += f", mouse to picture {1e3 * self.latency:.0f} ms"
        lines.append(f"{numbers}, {len(self.browsers)} browser{'s' * (len(self.browsers) != 1)}")
        lines += [f"{name}: {np.linalg.norm(tool.force):.2f} N" for name, tool in self.tools.items()]
        if any(browser.wants_stress for browser in self.browsers.values()):
            lines.append(f"red: von Mises stress of {self.stress_colors.scale / 1e3:.2g} kPa")
        if any(browser.wants_stiffness for browser in self.browsers.values()):
            lines.append(self.stiffness_colors.legend)
        if now < self._notice_until:
            lines.append(f"**{self.notice}**")
        self._text.content = "  \n".join(lines)

    # ---------------------------------------------------------------- the page

    def _build_page(self) -> None:
        scene, gui = self._server.scene, self._server.gui
        scene.configure_environment_map(None)  # only arrows are lit; surroundings and shadows cost seconds where a GPU is missing
        scene.configure_default_lights(cast_shadow=False)
        scene.add_light_ambient("/light", intensity=1.0)
        self._text = gui.add_markdown("waiting for a model")
        gui.add_markdown("*Shift* + drag pulls tissue, *Ctrl* + drag up lifts it.")

        def button(label: str, act: Callable[[], None], hint: str) -> Any:
            made = gui.add_button(label, hint=hint)
            made.on_click(lambda _: self.post(act))
            return made

        self._play = button("pause", lambda: self.actions.pause(not self.paused), "Let time stand still, or go on.")
        button("step", self.actions.step, "One step while time stands still.")
        button("reset", self.reset, "Tissue back to rest.")
        with gui.add_folder("tissue"):
            self.sliders = Sliders(gui, lambda slider, value: self.post(lambda: self.sliders.slide(slider, value)))
        self.marks = ToolMarks(scene)
        self._server.on_client_connect(lambda client: self.post(lambda: self._join(client)))
        self._server.on_client_disconnect(lambda client: self.post(lambda: self.leave(client.client_id)))

    def _show_model_in(self, browser: Browser) -> None:
        if self.renderer is not None and self.camera is not None:
            browser.show_model(self.renderer.model.means.cpu().numpy(), self.camera)

    def _render(self, camera: Camera) -> np.ndarray:
        """The tissue as it is now [H, W, 3] uint8, seen by a camera."""
        if self.renderer is None:
            return np.zeros((camera.height, camera.width, 3), np.uint8)
        return self.renderer.views([camera], *(self.state or ()), depth=False, instruments=self.instruments)[0].image

    def _join(self, client: Any) -> None:
        browser = self.browsers[client.client_id] = Browser(client, self.post, self.point)
        browser.on_record(lambda: browser.record(Path(self.config.videos).expanduser(), self.config.rate))
        browser.on_changed(lambda: setattr(self, "_dirty", True))
        self._show_model_in(browser)
        self._dirty = True

    def leave(self, client: int) -> None:
        """Forget a browser that is gone, and what it held."""
        browser = self.browsers.pop(client, None)
        if browser is not None:
            browser.close()
        if client == self._holder:
            self.release()

    def stop(self) -> None:
        """End the page."""
        for browser in self.browsers.values():
            browser.close()
        self._server.stop()


def serve(config: ViewerConfig) -> Any:
    """A server of a page with an empty panel; raises ConfigError if viser is not installed or it cannot be served at that address."""
    try:
        import viser
    except ImportError:
        raise ConfigError("the viewer needs viser, which is not installed: pip install 'endo_sim_ros[viewer]'") from None
    logging.getLogger("websockets").setLevel(logging.WARNING)  # else it tells of every browser that comes and goes
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # browsers leave while they are drawn for
    try:
        _try_address(config.host, config.port)
        server = viser.ViserServer(host=config.host, port=config.port, verbose=False)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"the page cannot be served at {config.host}:{config.port} ({reason}); give another host or port") from error
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.gui.set_panel_label("endo-sim")
    server.gui.main_panel.dock_right()  # beside the picture, which it would cover otherwise
    server.gui.main_panel.set_width(_PANEL_WIDTH)
    return server


def _try_address(host: str, port: int) -> None:
    """Raise OSError where nothing can be served, for which viser would wait for ever; a port that is taken is left to it."""
    (family, kind, protocol, _, address), *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    with socket.socket(family, kind, protocol) as tried:
        try:
            tried.bind(address)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise


def plain_camera(pose: np.ndarray) -> Camera:
    """A camera at a pose [4, 4] for scenes that come without one."""
    width, height = 640, 512
    return Camera(np.array([[_FOCAL * width, 0, width / 2], [0, _FOCAL * width, height / 2], [0, 0, 1]]), width, height, pose)
