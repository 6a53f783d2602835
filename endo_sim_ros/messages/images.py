"""Images, depth images and masks."""

import cv2
import numpy as np
from numpy.typing import DTypeLike

from endo_sim_ros.messages.headers import make_header
from endo_sim_ros.messages.topics import DEPTH, LEFT_IMAGE, MASK, RENDERED_SEGMENTATION
from endo_sim_ros.messages.types import Message, MessageError, MessageTypes, ros_types

__all__ = ["decode_depth", "decode_image", "decode_labels", "decode_mask", "encode_compressed", "encode_image"]

_COLOR_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}
_ENCODINGS = {("uint8", 3): "rgb8", ("uint8", 1): "mono8", ("float32", 1): "32FC1"}  # by dtype and channels


def _pixels(message: Message, dtype: DTypeLike, channels: int, topic: str) -> np.ndarray:
    """View of the pixel data [H, W, channels]. Honours row padding and byte order."""
    kind = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    height, width, row = message.height, message.width, message.width * channels * kind.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if height == 0 or width == 0:
        raise MessageError(f"{topic}: the image is empty ({width}×{height})")
    if message.step < row or data.size < message.step * height:
        raise MessageError(
            f"{topic}: {data.size} bytes and step {message.step} do not hold a {width}×{height} {message.encoding} image, "
            f"which needs {row} bytes a row; the publisher's size and data disagree"
        )
    rows = data[: message.step * height].reshape(height, message.step)[:, :row]
    return np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)


def decode_image(message: Message, topic: str = LEFT_IMAGE.name) -> np.ndarray:
    """RGB image [H, W, 3] uint8 of an Image or CompressedImage. It is a view of the message where the encoding is rgb8.

    Raises:
        MessageError: If the encoding is not supported, or size and data disagree.
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed(message, topic)
    if message.encoding not in _COLOR_CHANNELS:
        raise MessageError(f"{topic}: encoding {message.encoding!r} is not supported; publish rgb8, bgr8 or mono8")
    pixels = _pixels(message, np.uint8, _COLOR_CHANNELS[message.encoding], topic)
    if pixels.shape[2] == 1:
        return np.repeat(pixels, 3, 2)
    swap = message.encoding in ("bgr8", "bgra8", "8UC3")
    return np.ascontiguousarray(pixels[..., 2::-1]) if swap else pixels[..., :3]


def _decode_compressed(message: Message, topic: str) -> np.ndarray:
    data = np.frombuffer(message.data, np.uint8)
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    except cv2.error:  # its size is beyond OPENCV_IO_MAX_IMAGE_PIXELS
        pixels = None
    if pixels is None:
        what = f"{data.size} bytes of format {message.format!r}"
        raise MessageError(f"{topic}: {what} are not a readable jpeg or png image of at most 64 megapixels")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def decode_depth(message: Message, topic: str = DEPTH.name) -> np.ndarray:
    """Depth [H, W] float32, metres, 0 = no measurement, of a 32FC1 (m) or 16UC1 (mm) Image.

    Raises:
        MessageError: If the encoding is not supported, or size and data disagree.
    """
    if message.encoding == "32FC1":
        depth = _pixels(message, np.float32, 1, topic)[..., 0].astype(np.float32)
    elif message.encoding in ("16UC1", "mono16"):
        depth = _pixels(message, np.uint16, 1, topic)[..., 0].astype(np.float32) * np.float32(1e-3)
    else:
        raise MessageError(f"{topic}: encoding {message.encoding!r} is not supported; publish 32FC1 (metres) or 16UC1 (millimetres)")
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def decode_labels(message: Message, topic: str = RENDERED_SEGMENTATION.name) -> np.ndarray:
    """What is in each pixel [H, W] uint8, of a mono8 Image.

    Raises:
        MessageError: If the encoding is not supported, or size and data disagree.
    """
    if message.encoding not in ("mono8", "8UC1"):
        raise MessageError(f"{topic}: encoding {message.encoding!r} is not supported; publish mono8, a label for each pixel")
    return _pixels(message, np.uint8, 1, topic)[..., 0]


def decode_mask(message: Message, topic: str = MASK.name) -> np.ndarray:
    """Mask [H, W] uint8, 255 = tissue, 0 = ignore, of a mono8 Image.

    Raises:
        MessageError: If the encoding is not supported, or size and data disagree.
    """
    if message.encoding not in ("mono8", "8UC1"):
        raise MessageError(f"{topic}: encoding {message.encoding!r} is not supported; publish mono8 with 255 = tissue")
    return np.where(_pixels(message, np.uint8, 1, topic)[..., 0] >= 128, np.uint8(255), np.uint8(0))


def encode_image(pixels: np.ndarray, stamp_ns: int, frame_id: str, types: MessageTypes = ros_types()) -> Message:
    """Image of uint8 [H, W, 3] (rgb8), uint8 [H, W] (mono8) or float32 [H, W] (32FC1, metres).

    Raises:
        MessageError: If there is no encoding for the dtype and the number of channels.
    """
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    encoding = _ENCODINGS.get((pixels.dtype.name, channels))
    if encoding is None:
        raise MessageError(f"encode_image: no encoding for dtype {pixels.dtype} with {channels} channels")
    return types.Image(
        header=make_header(types, stamp_ns, frame_id),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.shape[1] * channels * pixels.itemsize,
        data=types.sequence(np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)),
    )


def encode_compressed(pixels: np.ndarray, stamp_ns: int, frame_id: str, quality: int, types: MessageTypes = ros_types()) -> Message:
    """CompressedImage (JPEG) of an RGB image [H, W, 3] uint8; quality 1 to 100."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    header = make_header(types, stamp_ns, frame_id)
    return types.CompressedImage(header=header, format="rgb8; jpeg compressed bgr8", data=types.sequence(data.reshape(-1)))
