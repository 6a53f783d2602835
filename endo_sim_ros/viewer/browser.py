"""One browser: its view of the tissue, and its mouse."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera, make_pose
from endo_sim_ros.core.drawing import draw_points, write_video

CENTIMETRES = 100.0  # units of the page in a metre: its covariances are half floats, which would vanish in m²
SPLATS, RENDERED, ENDOSCOPE = VIEWS = ("orbit", "orbit, rendered here", "endoscope")
_NODES = ("hidden", "positions", "stress", "stiffness")
_PLAIN = (90, 230, 140)  # colour of nodes
_LARGEST = 640, 512  # pixels of rendered pictures
_ROOM = 20.0  # size of the invisible box around the tissue in which the mouse is heard, in sizes of the tissue
JPEG_QUALITY = 85


Render = Callable[[Camera], np.ndarray]
DrawTools = Callable[[np.ndarray, Camera], np.ndarray]


class Pointer(NamedTuple):
    """Where a mouse is that holds tissue."""

    client: int
    phase: str  # start, update, end
    began_at: tuple[float, float]  # in the picture, 0 to 1 from the left and from the top
    at: tuple[float, float]
    lifts: bool  # towards the user, rather than across the picture


class Browser:
    """What one client sees. Made and called in the viewer's thread; hands to it, through ``post``, what its user does."""

    def __init__(self, client: Any, post: Callable[[Callable[[], None]], None], point: Callable[[Pointer], None]):
        self.client, self._post, self._point = client, post, point
        self._changed: Callable[[], None] = lambda: None
        self._splats = self._points = self._room = None
        self._camera_shown: tuple | None = None  # of the newest rendered picture
        self._endoscope_shown: tuple[np.ndarray | None, float] = None, 0.0  # its picture, and the aspect that it was shown in
        self._video: VideoRecorder | None = None
        gui = client.gui
        with gui.add_folder("view"):
            self._view = gui.add_dropdown(
                "view", VIEWS, hint="Drawn by the browser, by this package for slow browsers, or what the endoscope sees."
            )
            self._tissue = gui.add_checkbox("tissue", True, hint="Show the Gaussians.")
            self._nodes = gui.add_dropdown("nodes", _NODES, hint="Show the control nodes, in colours or not.")
            self._mouse = gui.add_dropdown("drag", ("turns", "pulls"), hint="What dragging without Shift does.")
            self._button = gui.add_button("record video")
        for element in (self._view, self._tissue, self._nodes, self._mouse):
            element.on_update(lambda _: post(self._choose))

    def on_changed(self, call: Callable[[], None]) -> None:
        """Call this when the user has chosen something else to see."""
        self._changed = call

    def on_record(self, call: Callable[[], None]) -> None:
        """Call this, in the viewer's thread, when the user presses the button of the video."""
        self._button.on_click(lambda _: self._post(call))

    @property
    def view(self) -> str:
        """The chosen view, one of `VIEWS`."""
        return self._view.value

    @property
    def wants_splats(self) -> bool:
        """Whether the browser draws the Gaussians itself."""
        return self.view == SPLATS and self._tissue.value

    @property
    def wants_nodes(self) -> bool:
        """Whether control nodes are shown."""
        return self._nodes.value != _NODES[0]

    @property
    def wants_stress(self) -> bool:
        """Whether control nodes are coloured by their stress."""
        return self._nodes.value == _NODES[2]

    @property
    def wants_stiffness(self) -> bool:
        """Whether control nodes are coloured by their stiffness."""
        return self._nodes.value == _NODES[3]

    def _choose(self) -> None:
        """Follow the controls."""
        if self._splats is not None:
            self._splats.visible = self.wants_splats
        if self._points is not None:
            self._points.visible = self.wants_nodes
        if self.view == SPLATS or not self._tissue.value:
            self.client.scene.set_background_image(None)
        self._camera_shown, self._endoscope_shown = None, (None, 0.0)
        if self._room is not None:
            self._room.remove_drag_callback()
            self._listen(self._room)
        self._changed()

    # ----------------------------------------------------------------- mouse

    def show_model(self, means: np.ndarray, camera: Camera) -> None:
        """Show a new model, at first as the endoscope sees it.

        Args:
            means: Centres of its Gaussians [N, 3], metres, world.
            camera: The endoscope's.
        """
        for handle in (self._splats, self._points, self._room):
            if handle is not None:
                handle.remove()
        self._splats = self._points = None
        means = CENTIMETRES * means
        low, high = means.min(0), means.max(0)
        size = _ROOM * float((high - low).max())
        self._room = self.client.scene.add_box(
            "/room", dimensions=(size, size, size), position=(low + high) / 2, opacity=0.0, side="back", cast_shadow=False
        )  # seen from inside only, so that it hides nothing
        self._listen(self._room)
        self.look_from(camera)
        self._camera_shown, self._endoscope_shown = None, (None, 0.0)

    def _listen(self, room: Any) -> None:
        """Hear drags in the box; plain ones where they are not for turning."""
        plain = self._mouse.value == "pulls" or self.view == ENDOSCOPE
        hear_drags(room, lambda pointer: self._post(lambda: self._point(pointer)), plain)

    def camera(self) -> Camera:
        """The camera of the picture that the browser shows, metres."""
        camera = self.client.camera
        width, height = max(camera.image_width, 1), max(camera.image_height, 1)
        focal = height / 2 / np.tan(camera.fov / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Camera(K, width, height, make_pose(camera.position / CENTIMETRES, camera.wxyz))

    def ray(self, x: float, y: float) -> tuple[np.ndarray, np.ndarray, Camera]:
        """Origin [3], m, and direction [3] with unit depth of what is seen at a place of the picture (0 to 1), and its camera."""
        camera = self.camera()
        local = np.linalg.solve(camera.K, [x * camera.width, y * camera.height, 1.0])
        return camera.position, camera.pose[:3, :3] @ local, camera

    def look_from(self, camera: Camera) -> None:
        """Put the browser's camera where another one is, with the same field of view around the optical axis."""
        mine, old = self.client.camera, self.camera()
        _, _, height = around_axis(camera, old.width / old.height)
        fov = float(2 * np.arctan(height / 2 / camera.K[1, 1]))
        if abs(mine.fov - fov) > 1e-6:
            mine.fov = fov
        if not np.allclose(old.pose, camera.pose, atol=1e-5):
            distance = np.linalg.norm(mine.look_at - mine.position) or 10.0
            mine.up_direction = -camera.pose[:3, 1]
            mine.position = CENTIMETRES * camera.position
            mine.look_at = CENTIMETRES * camera.position + distance * camera.pose[:3, 2]

    # --------------------------------------------------------------- pictures

    def show_splats(self, centers: np.ndarray, covariances: np.ndarray, rgbs: np.ndarray, opacities: np.ndarray) -> None:
        """Show Gaussians.

        Args:
            centers: Their centres [N, 3], cm, world.
            covariances: Their covariances [N, 3, 3], cm², world.
            rgbs: Colours [N, 3] uint8.
            opacities: Opacities [N, 1] uint8, 255 = opaque.
        """
        if self._splats is None:
            self._splats = self.client.scene.add_gaussian_splats("/tissue", centers, covariances, rgbs, opacities)
        self._splats.visible = True
        self._splats.set_gaussians(centers, covariances, rgbs, opacities)

    def show_nodes(self, positions: np.ndarray, colors: np.ndarray | None, size: float) -> None:
        """Nodes at positions [M, 3], m, in colours [M, 3] uint8, as points of a size in cm."""
        points = (CENTIMETRES * positions).astype(np.float32)
        colors = np.tile(np.array(_PLAIN, np.uint8), (len(points), 1)) if colors is None else colors
        if self._points is not None and len(self._points.points) != len(points):
            self._points.remove()
            self._points = None
        if self._points is None:
            self._points = self.client.scene.add_point_cloud(
                "/nodes", points, colors, point_size=size, point_shape="circle", precision="float32"
            )
        self._points.visible, self._points.points, self._points.colors = True, points, colors

    def show_picture(self, render: Render, endoscope: tuple[np.ndarray, Camera] | None, draw_tools: DrawTools, changed: bool) -> None:
        """Show a picture behind the splats where the chosen view has one, and add one to the video.

        Args:
            render: Draws the tissue as a camera sees it, [H, W, 3] uint8.
            endoscope: The endoscope's newest picture [H, W, 3] uint8, and its camera.
            draw_tools: Draws the tools onto a picture of a camera.
            changed: Whether the tissue looks different from the last call.
        """
        picture = None
        if self.view == ENDOSCOPE and endoscope is not None:
            picture = endoscope
            self.look_from(picture[1])
            aspect = self.client.camera.image_width / max(self.client.camera.image_height, 1)
            image, shown_aspect = self._endoscope_shown
            if self._tissue.value and (picture[0] is not image or aspect != shown_aspect):
                self._endoscope_shown = picture[0], aspect
                self._send(padded(*picture, aspect))
        elif self.view == RENDERED and self._tissue.value:
            camera = _small(self.camera())
            shown = (camera.width, camera.height, camera.K[0, 0], camera.pose.tobytes())
            if changed or shown != self._camera_shown:
                self._camera_shown = shown
                picture = render(camera), camera
                self._send(picture[0])
        if self._video is not None and self._video.due:
            if picture is None:
                camera = _small(self.camera())
                picture = render(camera), camera
            self._video.add(draw_tools(self._with_nodes(picture[0], picture[1]), picture[1]))

    def _with_nodes(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        """The picture with the control nodes over it, where the browser shows them."""
        image, points = image if self._tissue.value else np.zeros_like(image), self._points
        if points is not None and self.wants_nodes:
            image = draw_points(image, camera, points.points / CENTIMETRES, points.colors, points.point_size / CENTIMETRES)
        return image

    def _send(self, image: np.ndarray) -> None:
        self.client.scene.set_background_image(image, "jpeg", jpeg_quality=JPEG_QUALITY)

    # ------------------------------------------------------------------ video

    def record(self, folder: Path, fps: float) -> None:
        """Begin a video of this view, or end it and offer it for download."""
        if self._video is None:
            folder.mkdir(parents=True, exist_ok=True)
            name = time.strftime("tissue_%Y%m%d_%H%M%S") + f"_{self.client.client_id}.mp4"
            self._video, self._button.label = VideoRecorder(folder / name, fps), "stop video"
            return
        video, self._video = self._video, None
        try:
            video.close()
        finally:
            self._button.label = "record video"
        self.client.send_file_download(video.path.name, video.path.read_bytes())

    def close(self) -> None:
        """The browser is gone."""
        if self._video is not None:
            with suppress(OSError):
                self._video.close()


def hear_drags(room: Any, tell: Callable[[Pointer], None], plain: bool) -> None:
    """Tell of drags in a box around what is seen: those with Shift pull, those with Ctrl lift, and plain ones pull if they shall."""

    def listen(modifier: str | None, lifts: bool) -> None:
        async def on_drag(event: Any) -> None:  # a coroutine, as only those are called in order
            tell(Pointer(event.client_id, event.phase, event.start_screen_pos, event.end_screen_pos, lifts))

        room.on_drag("left", modifier=modifier)(on_drag)

    listen("shift", False)
    listen("cmd/ctrl", True)
    if plain:
        listen(None, False)


class VideoRecorder:
    """A video at a constant rate: pictures that come late are repeated, those that come early are left out."""

    def __init__(self, path: Path, fps: float):
        self.path, self._fps = path, fps
        self._size: tuple[int, int] | None = None
        self._began, self.count = time.monotonic(), 0
        self._images: SimpleQueue[np.ndarray | None] = SimpleQueue()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._write)
        self._thread.start()

    def _write(self) -> None:
        def images() -> Iterator[np.ndarray]:
            while (image := self._images.get()) is not None:
                yield image

        try:
            write_video(self.path, images(), self._fps)
        except Exception as error:
            self._error = error

    @property
    def due(self) -> bool:
        """Whether it is time for the next picture."""
        return self.count <= (time.monotonic() - self._began) * self._fps

    def add(self, image: np.ndarray) -> None:
        """The picture [H, W, 3] uint8 that is seen now."""
        self._size = self._size or image.shape[1::-1]
        if image.shape[1::-1] != self._size:
            image = fitted(image, *self._size)
        while self.due:
            self._images.put(image)
            self.count += 1

    def close(self) -> None:
        """Write the rest.

        Raises:
            OSError: If there is no video after all.
        """
        self._images.put(None)
        self._thread.join()
        if self._error is not None or not self.count:
            raise OSError(f"{self.path}: no video was written ({self._error or 'there were no pictures'})")


def _small(camera: Camera) -> Camera:
    """The camera at the size of rendered pictures."""
    scale = min(1.0, _LARGEST[0] / camera.width, _LARGEST[1] / camera.height)
    return camera.resized(max(round(camera.width * scale), 2), max(round(camera.height * scale), 2))


def fitted(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The picture as large as there is room, undistorted, the rest black."""
    scale = min(width / image.shape[1], height / image.shape[0])
    small = cv2.resize(image, (max(round(scale * image.shape[1]), 1), max(round(scale * image.shape[0]), 1)))
    right, below = width - small.shape[1], height - small.shape[0]
    return cv2.copyMakeBorder(small, below // 2, below - below // 2, right // 2, right - right // 2, cv2.BORDER_CONSTANT)


def around_axis(camera: Camera, aspect: float) -> tuple[float, float, float]:
    """The smallest picture of an aspect that holds a camera's and is centred at its optical axis: the width of its pixels
    in those of the height (fy / fx), its width in such pixels, and its height."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    square = fy / fx
    width, height = 2 * max(cx, camera.width - cx) * square, 2 * max(cy, camera.height - cy)
    return square, max(width, height * aspect), max(height, width / aspect)


def padded(image: np.ndarray, camera: Camera, aspect: float) -> np.ndarray:
    """The picture in a black frame, such that it fills a canvas of an aspect and its optical axis is in the middle."""
    square, width, height = around_axis(camera, aspect)
    M = np.array([[square, 0, width / 2 - camera.K[0, 2] * square], [0, 1, height / 2 - camera.K[1, 2]]], np.float64)
    M[:, 2] += M[:, :2] @ [0.5, 0.5] - 0.5  # pixel centres are at half numbers
    return cv2.warpAffine(image, M, (round(width), round(height)), flags=cv2.INTER_LINEAR)
