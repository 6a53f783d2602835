"""Pictures for people: force arrows, coloured depth, labelled sheets and videos."""

import errno
import os
import re
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.folders import written_whole

_ARROW = (60, 230, 90)  # RGB, the green of the paper's figures
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_NARROWEST = 256  # pixels: a caption of six words is as wide in letters that can be read


def draw_force(image: np.ndarray, camera: Camera, tip: np.ndarray, force: np.ndarray, metres_per_newton: float) -> np.ndarray:
    """The RGB image with the force [3] (N, world) as an arrow from the tool tip [3] (m, world)."""
    image = np.ascontiguousarray(image.copy())
    uv, z = camera.project(np.stack([tip, tip + force * metres_per_newton]))
    if (z <= 0).any() or not np.isfinite(uv).all() or np.abs(uv).max() > 1e5:
        return image
    start, end = (tuple(int(round(value)) for value in point) for point in uv)
    width = max(round(camera.width / 200), 1)
    if np.linalg.norm(force) > 0:
        for color, extra in (((0, 0, 0), 2), (_ARROW, 0)):
            cv2.arrowedLine(image, start, end, color, width + extra, cv2.LINE_AA, tipLength=0.25)
    cv2.circle(image, start, width + 2, (255, 255, 255), -1, cv2.LINE_AA)
    cv2.circle(image, start, width + 2, (0, 0, 0), 1, cv2.LINE_AA)
    return image


def draw_points(image: np.ndarray, camera: Camera, points: np.ndarray, colors: np.ndarray, size: float) -> np.ndarray:
    """The RGB image with points [M, 3] (m, world) as discs of a diameter (m) in colours [M, 3] uint8, near ones over far ones."""
    image = np.ascontiguousarray(image.copy())
    uv, z = camera.project(points)
    inside = (z > 0) & (uv >= 0).all(1) & (uv < image.shape[1::-1]).all(1)
    order = np.flatnonzero(inside)[np.argsort(-z[inside])]
    radii = np.maximum(np.rint(0.5 * size * camera.K[1, 1] / z[order]), 1).astype(int)
    for center, radius, color in zip(np.rint(uv[order]).astype(int).tolist(), radii.tolist(), colors[order].tolist()):
        cv2.circle(image, center, radius, color, -1)
    return image


def color_depth(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """RGB picture [H, W, 3] of a depth image [H, W] (m), from red (near, m) to blue (far, m); black where there is none."""
    valid = depth > 0
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    scaled = np.clip((depth - near) / max(far - near, 1e-9), 0, 1)
    colors = cv2.applyColorMap((255 - scaled * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.where(valid[..., None], cv2.cvtColor(colors, cv2.COLOR_BGR2RGB), 0).astype(np.uint8)


def usual_depths(depth: np.ndarray) -> tuple[float, float]:
    """Depths between which 98 % of a depth image [H, W] lie, m; zeros where it has none."""
    low, high = np.percentile(depth[depth > 0], [1, 99]) if (depth > 0).any() else (0.0, 0.0)
    return float(low), float(high)


def depth_panel(depth: np.ndarray) -> tuple[str, np.ndarray]:
    """A label that tells the range, and the picture of a rendered depth image [H, W] (m)."""
    near, far = usual_depths(depth)
    return f"rendered depth, {100 * near:.1f} (red) to {100 * far:.1f} cm (blue)", color_depth(depth, near, far)


def label(image: np.ndarray, text: str) -> np.ndarray:
    """The RGB image [H, W, 3] uint8 under a strip with a line of text."""
    height = max(image.shape[1] // 16, 18)
    strip = np.full((height, image.shape[1], 3), 24, np.uint8)
    scale = height / 34
    room = image.shape[1] - height / 2
    width = cv2.getTextSize(text, _FONT, scale, 1)[0][0]
    scale *= min(1.0, room / max(width, 1))
    cv2.putText(strip, text, (height // 4, int(height * 0.7)), _FONT, scale, (235, 235, 235), 1, cv2.LINE_AA)
    return np.vstack([strip, image])


def sheet(pictures: list[tuple[str, np.ndarray]], columns: int = 3) -> np.ndarray:
    """One picture of labelled RGB pictures [H, W, 3] uint8 in rows, all resized to the first, which is enlarged where it is narrow."""
    height, width = pictures[0][1].shape[:2]
    times = -(-_NARROWEST // width)
    height, width = times * height, times * width
    cells = [label(cv2.resize(image, (width, height)), text) for text, image in pictures]
    cells += [np.zeros_like(cells[0])] * (-len(cells) % columns)
    return np.vstack([np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)])


def slug(text: str) -> str:
    """A text, such as a split's name, as part of a file's name."""
    return re.sub(r"[^\w.+-]+", "_", re.sub(r"(\d):(\d)", r"\1to\2", text))


def require_writable(path: Path) -> None:
    """Raise ValueError if no picture can be written there: asked before long work."""
    if not cv2.haveImageWriter(str(path)):
        raise ValueError(f"{path}: no such kind of picture can be written; let the name end in .png")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"{path}: the picture cannot be written; does the folder exist?")


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write an RGB image [H, W, 3] uint8.

    Raises:
        OSError: If it cannot be written; what was there before stays.
    """
    path = Path(path)
    data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    try:
        with written_whole(path) as partial:
            partial.write_bytes(data.tobytes())
    except FileNotFoundError:
        raise OSError(f"{path}: the picture cannot be written; does the folder exist?") from None
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else error.strerror
        raise OSError(f"{path}: the picture cannot be written: {reason}") from error


def jpeg(image: np.ndarray, quality: int) -> bytes:
    """The JPEG file of an RGB image [H, W, 3] uint8, of a quality from 0 to 100."""
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def check_video() -> None:
    """Find out whether `write_video` can write, before long work.

    Raises:
        RuntimeError: If there is no PyAV, or no libx264 in it.
    """
    try:
        _import_av().codec.Codec("libx264", "w")
    except ValueError as error:
        raise RuntimeError("PyAV has no libx264 here, which videos need; pip install --force-reinstall av brings it") from error


def _import_av() -> Any:
    """PyAV; raises RuntimeError if there is none."""
    try:
        import av
        import av.codec
    except ImportError as error:
        raise RuntimeError("there is no PyAV here, which videos need; pip install --force-reinstall av brings it") from error
    return av


def write_video(path: str | Path, images: Iterable[np.ndarray], fps: float, options: dict[str, str] = {"crf": "18"}) -> int:
    """Write RGB images [H, W, 3] uint8 of one size as H.264 that browsers play, and return their number.

    Args:
        path: File to write.
        images: An odd last row or column is left out.
        fps: Images per second.
        options: Of libx264.

    Raises:
        RuntimeError: As `check_video` does.
    """
    check_video()
    av = _import_av()
    count = 0
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000), options=options)
        stream.pix_fmt = "yuv420p"
        for image in images:
            image = np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])  # H.264 wants even sizes
            if not count:
                stream.height, stream.width = image.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            count += 1
        container.mux(stream.encode())
    return count


def count_images(path: str | Path) -> int:
    """Number of images that a video holds, without decoding them.

    Raises:
        OSError: If it cannot be read.
        ValueError: If it is no video, or its end is missing.
        RuntimeError: If there is no PyAV.
    """
    with _import_av().open(str(path)) as container:
        return sum(packet.size > 0 for packet in container.demux(video=0))


def read_video(path: str | Path) -> np.ndarray:
    """All images of a video [T, H, W, 3], uint8, RGB.

    Raises:
        OSError: If it cannot be read.
        RuntimeError: If there is no PyAV.
    """
    with _import_av().open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
