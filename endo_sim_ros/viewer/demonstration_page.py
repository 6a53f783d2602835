"""The page on which a person demonstrates a task: the endoscope's picture, a mouse and keys that move the tip."""

import queue
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from endo_sim_ros.learning.by_person import View, Wish, Word
from endo_sim_ros.learning.person_config import PersonConfig
from endo_sim_ros.viewer.browser import JPEG_QUALITY, Pointer, around_axis, hear_drags, padded
from endo_sim_ros.viewer.config import ViewerConfig
from endo_sim_ros.viewer.viewer import serve

_ROOM = 1e4  # size of the invisible box in which the mouse is heard, in units of the page
_NAP = 0.002  # s between two looks at what happened in browsers
# Right, up, towards the endoscope; and turning to the left.
_KEYS = {
    "arrowleft": (-1, 0, 0, 0), "arrowright": (1, 0, 0, 0), "arrowdown": (0, -1, 0, 0), "arrowup": (0, 1, 0, 0),
    "S": (0, 0, -1, 0), "W": (0, 0, 1, 0), "Q": (0, 0, 0, 1), "E": (0, 0, 0, -1),
}  # fmt: skip
_WORDS: dict[Word, tuple[str, str]] = {
    "again": ("R", "This episode from its beginning."),
    "drop": ("X", "Do not keep the solved episode before this one; it comes again."),
    "next": ("N", "Another episode instead of this one."),
    "finish": ("F", "Keep what is solved, and end."),
}
_HELP = """*Drag* moves the tip across the picture, *Ctrl* + drag up towards you, from wherever the mouse is.
Keys: *arrows*, *W* nearer, *S* farther, *Q* and *E* turn."""


class DemonstrationPage:
    """A screen and a device of :mod:`endo_sim_ros.learning.by_person` in any number of browsers.

    What users do waits in a queue until `wait`, in whose thread everything happens.

    Args:
        config: Where the page is.

    Raises:
        ConfigError: If viser is not installed or the page cannot be served at that address.
    """

    def __init__(self, config: PersonConfig):
        self._events: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.browsers: dict[int, Any] = {}  # clients of viser
        self._view: View | None = None
        self._shown: dict[int, float] = {}  # aspect of each browser in which it has the picture
        self._at: dict[int, tuple[float, float]] = {}  # where mice that drag were last
        self._left = np.zeros(4)  # what was asked for and not been taken yet, in largest steps
        self._wish = Wish()
        self._config = config
        self._server = serve(ViewerConfig(host=config.host, port=config.port))
        gui = self._server.gui
        self._text = gui.add_markdown("getting ready")
        gui.add_markdown(_HELP)
        self._button("jaw", "space", "Close or open the jaw; the fourth number of the task.", lambda: self._set("jaw", not self._wish.jaw))
        self._button("other arm", "T", "Act with the next arm of the task.", lambda: self._set("arm", True))
        for word, (key, hint) in _WORDS.items():
            self._button(word, key, hint, lambda word=word: self._set("word", word))
        for key, way in _KEYS.items():
            gui.add_command(f"move {key}", hotkey=key).on_trigger(lambda _, way=way: self.post(lambda: self._ask(np.array(way, float))))
        self._server.on_client_connect(lambda client: self.post(lambda: self._join(client)))
        self._server.on_client_disconnect(lambda client: self.post(lambda: self.browsers.pop(client.client_id, None)))

    @property
    def url(self) -> str:
        """Address of the page, as a browser on this machine reaches it."""
        host = "localhost" if self._config.host in ("0.0.0.0", "::") else self._config.host
        return f"http://{host}:{self._server.get_port()}"

    # ------------------------------------------------------------ as a screen

    def show(self, view: View) -> None:
        """Show a picture and what there is to say, in all browsers."""
        if self._view is None or view.lines != self._view.lines:
            self._text.content = "  \n".join((f"**{view.lines[0]}**", *view.lines[1:]))
        changed = self._view is None or not np.array_equal(view.image, self._view.image)
        self._view = view
        for number, client in self.browsers.items():
            aspect = self._aspect(client)
            if changed or self._shown.get(number) != aspect:
                self._shown[number] = aspect
                client.scene.set_background_image(padded(view.image, view.camera, aspect), "jpeg", jpeg_quality=JPEG_QUALITY)

    def wait(self, until: float) -> None:
        """Take what users do until a time of the clock."""
        while True:
            while not self._events.empty():
                self._events.get()()
            left = until - time.monotonic()
            if left <= 0:
                return
            time.sleep(min(left, _NAP))

    def stop(self) -> None:
        """End the page."""
        self._server.stop()

    # ------------------------------------------------------------ as a device

    def read(self) -> Wish:
        """What mice and keys ask for: of a long way its first step."""
        step = np.clip(self._left, -1, 1)
        self._left -= step
        wish, self._wish = self._wish, Wish()
        wish.way, wish.turn = step[:3], float(step[3])
        return wish

    def post(self, event: Callable[[], None]) -> None:
        """Have something done by the next `wait`, from any thread."""
        self._events.put(event)

    def point(self, pointer: Pointer) -> None:
        """The mouse drags: the tip goes as far in the picture as it does, or towards the endoscope as far as it goes up."""
        before = self._at.get(pointer.client, pointer.began_at)
        if pointer.phase == "start":
            before, self._left = pointer.began_at, np.zeros(4)
        self._at[pointer.client] = pointer.at
        if self._view is None or pointer.client not in self.browsers:
            return
        _, width, height = around_axis(self._view.camera, self._aspect(self.browsers[pointer.client]))
        right, up = (np.subtract(pointer.at, before) * (width, -height) * self._view.pixel).tolist()
        self._left += (0, 0, up, 0) if pointer.lifts else (right, up, 0, 0)

    def _ask(self, way: np.ndarray) -> None:
        self._left += way

    def _set(self, what: str, value: Any) -> None:
        setattr(self._wish, what, value)
        if what == "word":
            self._left[:] = 0

    def _button(self, label: str, key: Any, hint: str, act: Callable[[], None]) -> None:
        """A button that is a key, too."""
        shown = f"{label} ({key})"
        self._server.gui.add_button(shown, hint=hint).on_click(lambda _: self.post(act))
        self._server.gui.add_command(label, description=hint, hotkey=key).on_trigger(lambda _: self.post(act))

    @staticmethod
    def _aspect(client: Any) -> float:
        return max(client.camera.image_width, 1) / max(client.camera.image_height, 1)

    def _join(self, client: Any) -> None:
        room = client.scene.add_box("/room", dimensions=(_ROOM,) * 3, opacity=0.0, side="back", cast_shadow=False)
        hear_drags(room, lambda pointer: self.post(lambda: self.point(pointer)), True)
        self.browsers[client.client_id] = client
