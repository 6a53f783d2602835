"""Camera poses from the images alone by VGGT (Wang et al. 2025), a network: faster than structure from motion, but not adjusted to them.

It reads a checkpoint on this machine with the authors' package `vggt` and downloads nothing.
"""

import logging
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from endo_sim_ros.core.cameras import intrinsic_matrix, invert_pose
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.images import image_size
from endo_sim_ros.sequences.structure_from_motion import StructureFromMotion, View, recorded_units, scale_to_metres

logger = logging.getLogger(__name__)

_WIDTH, _PATCH = 518, 14  # pixels; that of the images that it was trained with, and what sides are multiples of


def estimate_poses_with_vggt(
    views: Iterable[View],
    K: np.ndarray | None = None,
    *,
    baseline: float | None = None,
    scale: float | None = None,
    checkpoint: str = "",
    **_: Any,
) -> StructureFromMotion:
    """Estimate where the camera was for every image; arguments and result are those of `estimate_poses`, whose others have no effect.

    Args:
        views: Seen all at once: a GPU has memory for some hundred.
        K: Intrinsics [3, 3]; None takes the median of what the network sees.
        baseline: Distance from left to right camera, metres; makes the result metric.
        scale: Median depth that the network sees, metres; None takes it from recorded depth, and is a guess without any.
        checkpoint: Folder with config.json and model.safetensors; empty: facebook/VGGT-1B in Hugging Face's cache.

    Raises:
        SequenceError: If there is no checkpoint, no package vggt, or fewer than two images.
    """
    views = list(views)
    left = [view.image for view in views]
    right = [view.right for view in views if view.right is not None and baseline is not None]
    if len(left) < 2 or len(right) not in (0, len(left)):
        raise SequenceError(f"VGGT needs 2 or more images, and a right one for each or none; got {len(left)} and {len(right)}")
    network, unpack = _load(checkpoint)
    width, height = image_size(left[0])
    size = _WIDTH, max(round(height * _WIDTH / width / _PATCH), 1) * _PATCH
    device = pick_device("auto")
    stack = np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (*left, *right)])
    with torch.no_grad():
        seen = network.to(device)(torch.from_numpy(stack).to(device).permute(0, 3, 1, 2).float() / 255)
        extrinsics, intrinsics = (x[0].double().cpu().numpy() for x in unpack(seen["pose_enc"], size[::-1]))
    poses = [invert_pose(np.vstack([view, [0, 0, 0, 1]])) for view in extrinsics]
    pairs = [float(np.linalg.norm(b[:3, 3] - a[:3, 3])) for a, b in zip(poses[: len(left)], poses[len(left) :])]
    z = seen["depth"][0, ..., 0].float().cpu().numpy() if "depth" in seen else None
    units = []
    for view, own in zip(views, () if z is None else z):
        if view.depth is not None:
            units += recorded_units(cv2.resize(view.depth, own.shape[::-1], interpolation=cv2.INTER_NEAREST), own)
    factor, metric = scale_to_metres(pairs, baseline, scale, np.ones(1) if z is None else z, units)
    to_first = invert_pose(poses[0])
    placed = {number: to_first @ pose for number, pose in enumerate(poses[: len(left)])}
    for pose in placed.values():
        pose[:3, 3] *= factor
    if K is None:
        fx, fy = np.median(intrinsics[:, [0, 1], [0, 1]], 0) * np.array([width, height]) / size
        K = intrinsic_matrix(fx, fy, width / 2, height / 2)
        logger.warning("VGGT sees focal lengths of %.1f and %.1f px, which may be wrong; pass the calibration if known", fx, fy)
    return StructureFromMotion(placed, np.asarray(K, np.float64), (), float("nan"), metric)


def find_checkpoint(checkpoint: str) -> Path:
    """The folder of a checkpoint; of facebook/VGGT-1B in Hugging Face's cache where that is empty.

    Raises:
        SequenceError: If there is none; the message says where to put one.
    """
    home = Path(os.environ.get("HF_HUB_CACHE", Path(os.environ.get("HF_HOME", "~/.cache/huggingface")) / "hub")).expanduser()
    cached = sorted(home.glob("models--facebook--VGGT-1B/snapshots/*"))
    folder = Path(checkpoint).expanduser() if checkpoint else cached[-1] if cached else home
    if not (folder / "config.json").is_file():
        advice = "copy facebook/VGGT-1B (config.json and model.safetensors) to this machine and pass poses=vggt:FOLDER"
        raise SequenceError(f"{folder}: there is no checkpoint of VGGT; {advice}")
    return folder


def _load(checkpoint: str) -> tuple[Any, Any]:
    """The network, and what makes cameras of its encoding of poses."""
    folder = find_checkpoint(checkpoint)
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    try:
        from vggt.models.vggt import VGGT  # pyright: ignore[reportMissingImports]  (optional)
        from vggt.utils.pose_enc import pose_encoding_to_extri_intri  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise SequenceError(f"poses=vggt needs the package vggt (github.com/facebookresearch/vggt): {error}") from error
    try:
        return VGGT.from_pretrained(str(folder), local_files_only=True).eval(), pose_encoding_to_extri_intri
    except Exception as error:  # whatever a damaged file makes the libraries raise
        raise SequenceError(f"{folder}: not a readable checkpoint of VGGT ({next(iter(str(error).splitlines()), '')})") from error
