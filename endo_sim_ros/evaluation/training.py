"""One cell in the process of its training: `train_and_measure`."""

import contextlib
import dataclasses
import functools
import logging
import multiprocessing
import pickle
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from endo_sim_ros.core import drawing
from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.device import cpu_threads
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.cells import Cell
from endo_sim_ros.evaluation.deformed_truth import deformed_truth_psnr
from endo_sim_ros.evaluation.deformed_views import deformed_view_psnr
from endo_sim_ros.evaluation.gsplat_trainers import STRATEGIES, GsplatTrainer
from endo_sim_ros.evaluation.held_out import difference, drawer, mean_figures, measure, seen_pixels
from endo_sim_ros.evaluation.lpips import Lpips
from endo_sim_ros.evaluation.measurement import machine, peak_megabytes
from endo_sim_ros.evaluation.preparation import Prepared
from endo_sim_ros.evaluation.sources import find_patient
from endo_sim_ros.evaluation.splits import split_views
from endo_sim_ros.reconstruction import Progress, ReconstructionConfig, Trainer, prepare, reconstruct, shrink
from endo_sim_ros.reconstruction.triangulation import points_in_view
from endo_sim_ros.sequences.recording import spread

_SHOWN = 3  # held-out views of a cell of which pictures are kept
_QUALITY = 92  # of these pictures, as JPEG
_CURVE_VIEWS = 8  # held-out views measured at each moment of a curve


@functools.lru_cache(maxsize=1)
def _load(file: Path) -> Prepared:
    return pickle.loads(file.read_bytes())


_network = functools.lru_cache(maxsize=2)(Lpips)


@functools.lru_cache(maxsize=1)
def _warm_up(device: str) -> None:
    """Load or compile every kernel, which is no part of the time of a training."""
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    camera, poses = Camera(intrinsic_matrix(60, 60, 32, 24), 64, 48), np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.005
    frames = [Frame(i, image, camera.at(pose), depth=np.full((48, 64), 0.1, np.float32)) for i, pose in enumerate(poses)]
    with contextlib.suppress(SequenceError):  # they need not make a scene
        reconstruct(frames, ReconstructionConfig(iterations=3, max_gaussians=500, depth="topic", device=device))


def train_and_measure(argument: tuple[Cell, Path | None, Prepared | Path], device: str, report: Callable[[Any], None]) -> dict[str, Any]:
    """Return the record of one cell, trained and measured here; the process that asked for it, maybe on another host, writes it.

    Args:
        argument: The cell, the folder of the weights of LPIPS (None: torch's cache), and its sequence or a pickle file of that.
        device: Compute device: cpu or cuda:N.
        report: Takes (done, total, text) while the cell runs.

    Raises:
        SequenceError: If the split needs views that the sequence lacks.
    """
    cell, weights, prepared = argument
    if multiprocessing.parent_process() is not None:  # a worker, whose warnings come between those of others
        name = f"{cell.sequence}, {cell.split}, {cell.method}" + f", seed {cell.seed}" * (cell.seed > 0)
        logging.basicConfig(level=logging.WARNING, format=name.replace("%", "%%") + ": %(message)s", force=True)
    if isinstance(prepared, Path):
        prepared = _load(prepared)
    config = ReconstructionConfig.from_mapping(cell.options | {"device": device})
    split = split_views(cell.split, prepared.count, cell.most_held_out)
    views = [prepared.frames[number].load() for number in split.train]
    if not (cell.train_depth and prepared.depth_source == "recorded"):
        views = [dataclasses.replace(view, depth=None) for view in views]
    if cell.mono or split.right:
        views = [dataclasses.replace(view, right=None, baseline=None, right_K=None) for view in views]
    if split.right and not prepared.right:
        raise SequenceError("split stereo: the sequence has no right images")
    held_out = prepared.right if split.right else {number: prepared.frames[number] for number in split.held_out}
    load = lambda number: shrink(held_out[number].load(), config.image_width)
    # Light is fitted at the left eye, which carries the lamp.
    lamp_of = lambda number: prepared.frames[number].camera if split.right else None
    given = [
        *["right images"] * any(view.right is not None for view in views),
        *["recorded depth"] * any(view.depth is not None for view in views),
    ]
    report((0, 1, "warming up"))
    _warm_up(device)
    training: dict[str, Any] = {}

    def train() -> None:
        probes = [(load(number), lamp_of(number)) for number in spread(list(held_out), _CURVE_VIEWS)] if cell.curve else []
        training.update(_train(cell, views, config, prepared, probes, report))

    memory = peak_megabytes(train, device)
    views.clear()  # they are large
    model = training.pop("model")
    report((0, len(held_out), "measuring"))
    networks = [_network(name, weights, device) for name in cell.lpips]
    trained = [prepared.frames[number] for number in split.train]
    seen_by = [dataclasses.replace(shrink(view.load(), config.image_width), right=None) for view in trained]
    draw = drawer(model, training.pop("motion"), training.pop("drift"), training.pop("camera_errors"), device)
    shown = set(spread(list(held_out), _SHOWN))
    # Without reference depth that of the model tells what was seen.
    known = all(frame.depth for frame in [*held_out.values(), *trained])
    depth_of = lambda view: view.depth if known else draw(view, None)[1]
    surfaces = [(view.camera, depth_of(view), view.mask) for view in seen_by]

    def of_view(number: int, frame: Frame, image: np.ndarray, depth: np.ndarray) -> tuple[dict[str, float], dict[str, bytes], float]:
        seen = seen_pixels(frame.camera, depth if frame.depth is None or not known else frame.depth, surfaces)
        found = measure(image, depth, frame, seen, networks, prepared.judging)
        row = {"view": number} | {name: value for name, value in found.items() if np.isfinite(value)}
        pictures = _pictures(number, image, depth, frame) if number in shown else {}
        return row, pictures, _reference_at_points(frame, prepared.judging)

    cameras = [view.camera for view in seen_by]
    deformed = {"psnr_deformed": deformed_view_psnr(model, cameras, device)}
    if patient := find_patient(cell.source):
        shown_from = [load(number).camera for number in sorted(shown)]
        names = "psnr_deformed_truth", "psnr_undeformed"
        deformed |= dict(zip(names, deformed_truth_psnr(model, patient, cameras, shown_from, device)))
    deformed = {name: value for name, value in deformed.items() if np.isfinite(value)}
    rows, pictures, off, masked, size = [], {}, [], False, [0, 0]
    with ThreadPoolExecutor(cpu_threads()) as pool:  # measuring takes longer than drawing
        waiting = deque()
        for index, number in enumerate(held_out):
            frame = load(number)
            size = [frame.camera.width, frame.camera.height]
            masked |= frame.mask is not None and not frame.mask.all()
            waiting.append(pool.submit(of_view, number, frame, *draw(frame, lamp_of(number))))
            while len(waiting) > 2 * cpu_threads() or waiting and index == len(held_out) - 1:
                row, new, error = waiting.popleft().result()
                rows.append(row)
                pictures |= new
                off += [error] * bool(np.isfinite(error))
                report((len(rows), len(held_out), "measuring"))
    return {
        "machine": machine(device),
        "size": size,
        "train": split.train,
        "held_out": len(held_out),
        "masked": bool(masked),
        "depth_source": "none" if split.right else prepared.depth_source,
        "given": given,
        "reference_at_points": float(np.mean(off)) if off else None,
        "seen_by": "reference" if known else "model",
        "figures": mean_figures(rows) | deformed | {"seconds": training["seconds"], "gaussians": len(model), "megabytes": memory},
        "views": rows,
        "curve": training["curve"],
        "decisions": list(training["decisions"]),
        "pictures": pictures,
    }


def _reference_at_points(frame: Frame, judging: np.ndarray | None) -> float:
    """How far the reference depth is off at the scene points that judge, metres; NaN if there are not both."""
    if judging is None or frame.depth is None:
        return np.nan
    return metrics.depth_at_points(frame.depth, *points_in_view(frame.camera, judging), frame.mask)


def _train(
    cell: Cell,
    views: list[Frame],
    config: ReconstructionConfig,
    prepared: Prepared,
    probes: list[tuple[Frame, Camera | None]],
    report: Callable[[Any], None],
) -> dict[str, Any]:
    """Train, and for the curve measure on the probes, each with the camera where its lamp is. The seconds are those of training alone."""

    def now() -> float:
        if config.device != "cpu":
            torch.cuda.synchronize(config.device)
        return time.perf_counter()

    curve, decisions, start, away = [], (), now(), 0.0
    if cell.method in STRATEGIES:
        trainer = GsplatTrainer(views, prepared.points, config, cell.method)
    else:
        motion = prepared.motion if config.watch_motion else None
        told = lambda stage, done, total: report((done, max(total, 1), stage))
        scene = prepare(views, config, prepared.points if motion is None else prepared.still_points, told, motion)
        trainer, decisions = Trainer(scene, config), scene.decisions
    iterations, moments = trainer.iterations, cell.curve
    # Quality changes fastest in the beginning.
    due = sorted({round(iterations * 50 ** (i / max(moments - 1, 1) - 1)) for i in range(moments)})

    def on_progress(progress: Progress) -> None:
        nonlocal away
        report((progress.iteration, iterations, f"{progress.gaussians} Gaussians"))
        if not due or progress.iteration < due[0]:
            return
        while due and progress.iteration >= due[0]:
            due.pop(0)
        paused = now()
        draw = drawer(trainer.model, trainer.motion, trainer.drift, trainer.camera_errors, config.device)
        pairs = [(draw(probe, lamp)[0], probe.image, probe.mask) for probe, lamp in probes]
        curve.append(
            {
                "iteration": progress.iteration,
                "seconds": paused - start - away,
                "psnr": float(np.nanmean([metrics.psnr(*pair) for pair in pairs])),
                "psnr_gain": float(np.nanmean([metrics.psnr(metrics.gain_fitted(*p), *p[1:]) for p in pairs])),
            }
        )
        away += now() - paused

    model = trainer.run(on_progress, every=max(min(20, iterations // 50), 1))
    seconds = now() - start - away
    told = {"drift": trainer.drift, "motion": trainer.motion, "camera_errors": trainer.camera_errors, "decisions": decisions}
    return told | {"model": model, "seconds": seconds, "curve": curve}


def _pictures(view: int, image: np.ndarray, depth: np.ndarray, frame: Frame) -> dict[str, bytes]:
    """Pictures of a held-out view as JPEG files, by name."""
    reference = depth if frame.depth is None else frame.depth
    near, far = drawing.usual_depths(reference)
    pictures = {
        "reference": frame.image,
        "rendered": image,
        "difference": difference(image, frame.image, frame.mask),
        "depth": drawing.color_depth(depth, near, far),
    }
    if frame.depth is not None:
        pictures["reference_depth"] = drawing.color_depth(frame.depth, near, far)
    return {f"{view:04d}-{name}": drawing.jpeg(picture.astype(np.uint8), _QUALITY) for name, picture in pictures.items()}
