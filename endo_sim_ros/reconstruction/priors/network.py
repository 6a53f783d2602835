"""Depth from one image by a network such as Depth-Anything-V2, made metric by what is known of the scene.

Networks of this kind see inverse depth up to a scale and a shift. Those that claim to see metres learnt them in rooms and streets: their
depth is inverted and fitted alike. Checkpoints are read from this machine and never downloaded.
"""

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.reconstruction.stage_configs import NetworkDepthConfig

log = logging.getLogger(__name__)

# Of Depth-Anything-V2: the shorter side that it was trained at, pixels, and what sides are multiples of.
_SIDE, _PATCH = 518, 14
_METRIC = ("glpn", "zoedepth")  # architectures that give depth in metres; others do if their configuration says so

Network = Callable[[np.ndarray], np.ndarray]


def load_network(path: str, device: str) -> Network:
    """A function from an RGB image [H, W, 3], uint8, to relative inverse depth [H, W], float32.

    Args:
        path: Folder of a transformers checkpoint, or ONNX file; empty looks into Hugging Face's cache.
        device: Where transformers computes; ONNX Runtime picks its own.

    Raises:
        SequenceError: If there is no such checkpoint or it cannot be read; the message says where to put one.
    """
    place = find_network(path)
    try:
        return _onnx(place) if place.is_file() else _transformers(place, device)
    except ImportError as error:
        raise SequenceError(f"{place}: needs the package {error.name}; pip install 'endo_sim_ros[depth]'") from error
    except Exception as error:  # whatever a damaged file makes the libraries raise
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise SequenceError(f"{place}: not a readable depth network ({reason})") from error


def find_network(path: str) -> Path:
    """The folder of a transformers checkpoint, or ONNX file, at a path, or in Hugging Face's cache where that is empty.

    Raises:
        SequenceError: If there is none; the message says where to put one.
    """
    place = Path(path).expanduser() if path else cached_checkpoint()
    if place is None or not (place.is_file() or (place / "config.json").is_file()):
        where = place or _cache()
        raise SequenceError(
            f"{where}: there is no checkpoint of a depth network; copy the folder Depth-Anything-V2-Small-hf (config.json and "
            "model.safetensors), that of another depth network of transformers, or an ONNX export to this machine and give its path as "
            "depth_model"
        )
    return place


def cached_checkpoint() -> Path | None:
    """The largest Depth-Anything-V2 checkpoint in Hugging Face's cache, if there is any."""
    for size in ("Large", "Base", "Small"):
        for found in sorted(_cache().glob(f"models--depth-anything--Depth-Anything-V2-{size}-hf/snapshots/*/config.json")):
            return found.parent
    return None


def _cache() -> Path:
    home = Path(os.environ.get("HF_HOME", "~/.cache/huggingface")).expanduser()
    return Path(os.environ.get("HF_HUB_CACHE", home / "hub"))


def _transformers(folder: Path, device: str) -> Network:
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # a configuration may name a backbone that is elsewhere
    from transformers import AutoImageProcessor, AutoModelForDepthEstimation  # pyright: ignore[reportMissingImports]  (optional)

    model: Any = AutoModelForDepthEstimation.from_pretrained(folder, local_files_only=True).eval().to(device)
    kind = model.config.model_type
    metric = kind in _METRIC or getattr(model.config, "depth_estimation_type", "") == "metric"
    processor: Any = None
    if kind != "depth_anything":  # others want pictures of other sizes and colours
        processor = AutoImageProcessor.from_pretrained(folder, local_files_only=True)
    whole = {"do_pad": False} if kind == "zoedepth" else {}  # so that the depth is that of the picture alone

    def predict(image: np.ndarray) -> np.ndarray:
        if processor is None:
            scale = _SIDE / min(image.shape[:2])
            height, width = (max(round(side * scale / _PATCH), 1) * _PATCH for side in image.shape[:2])
            pixels = torch.from_numpy(_normalised(image, width, height))
        else:
            pixels = processor(image, return_tensors="pt", **whole).pixel_values
        with torch.no_grad():
            output = model(pixel_values=pixels.to(device))
        seen = output.predicted_depth[0].float().cpu().numpy()
        return _enlarged(1 / np.maximum(seen, 1e-3 * seen.max()) if metric else seen, image)

    return predict


def _onnx(file: Path) -> Network:
    import onnxruntime  # pyright: ignore[reportMissingImports]  (optional)

    session = onnxruntime.InferenceSession(str(file), providers=onnxruntime.get_available_providers())
    entry = session.get_inputs()[0]
    sides = [side if isinstance(side, int) else _SIDE for side in entry.shape[2:]]

    def predict(image: np.ndarray) -> np.ndarray:
        output = session.run(None, {entry.name: _normalised(image, sides[1], sides[0])})[0]
        return _enlarged(output.reshape(output.shape[-2:]), image)

    return predict


def _normalised(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The image [1, 3, height, width] as networks take it whose backbone was trained on ImageNet: by its mean and deviation."""
    mean, deviation = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], np.float32)
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    return np.ascontiguousarray(((small - mean) / deviation).transpose(2, 0, 1)[None])


def _enlarged(values: np.ndarray, image: np.ndarray) -> np.ndarray:
    return cv2.resize(values.astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def network_depth(
    frame: Frame, network: Network, known: np.ndarray, options: NetworkDepthConfig = NetworkDepthConfig()
) -> np.ndarray | None:
    """Metric depth [H, W] (m) of a view from the network, or None where it does not fit what is known.

    Args:
        frame: The view.
        network: What tells relative inverse depth.
        known: Pixels u, v and depths z (m) of points seen in this view [N, 3], some of them wrong.
        options: When a fit has failed.
    """
    relative = network(frame.image)
    u, v = np.floor(known[:, :2]).astype(int).T
    fit = align(relative[v, u], 1 / known[:, 2], options)
    if fit is None:
        log.warning("view %d: the depth network does not fit %s; left out", frame.stamp_ns, counted(len(known), "known depth"))
        return None
    scale, shift, error = fit
    log.info("view %d: depth network aligned to %s, median error %.1f %%", frame.stamp_ns, counted(len(known), "known depth"), 100 * error)
    inverse = scale * relative + shift
    nearest, farthest = 1 / known[:, 2].min(), 1 / known[:, 2].max()
    return (1 / np.clip(inverse, 0.5 * farthest, 2 * nearest)).astype(np.float32)


def align(
    relative: np.ndarray, inverse: np.ndarray, options: NetworkDepthConfig = NetworkDepthConfig()
) -> tuple[float, float, float] | None:
    """Scale and shift that take relative [N] to metric inverse depths [N] (1/m), and the median relative error left.

    A consensus of random pairs, then reweighted least squares (Cauchy). None if too few points, no positive scale or too large an error
    is left.
    """
    if len(relative) < 12 or np.ptp(relative) < 1e-9:  # two for the numbers, and enough to outvote wrong ones
        return None
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, len(relative), (2, 500))
    rise = relative[first] - relative[second]
    usable = np.abs(rise) > 1e-3 * np.ptp(relative)
    scales = (inverse[first] - inverse[second])[usable] / rise[usable]
    shifts = inverse[first][usable] - scales * relative[first][usable]
    errors = np.median(np.abs(scales[:, None] * relative + shifts[:, None] - inverse), axis=1)
    if not len(errors):
        return None
    scale, shift = scales[errors.argmin()], shifts[errors.argmin()]
    for _ in range(20):
        residual = scale * relative + shift - inverse
        spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
        weights = 1 / (1 + (residual / (2 * spread)) ** 2)
        mean_x, mean_y = np.average(relative, weights=weights), np.average(inverse, weights=weights)
        x = relative - mean_x
        scale = (weights * x * (inverse - mean_y)).sum() / max((weights * x * x).sum(), 1e-12)
        shift = mean_y - scale * mean_x
    left = np.abs(scale * relative + shift - inverse)
    error = float(np.median(left / inverse))
    explains = np.median(left) < options.max_unexplained * np.median(np.abs(inverse - np.median(inverse)))
    return (float(scale), float(shift), error) if scale > 0 and explains and error < options.max_error else None
