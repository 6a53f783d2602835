"""`endo-sim evaluate`: sequences × splits × methods × seeds, each trained and measured on its own."""

import contextlib
import dataclasses
import functools
import json
import logging
import pickle
import re
import tempfile
import time
import typing
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import yaml
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from scipy.spatial import cKDTree

from endo_sim_ros.core import drawing
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.device import cpu_threads, pick_device
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.evaluation import metrics, tables
from endo_sim_ros.evaluation.config import EvaluationConfig
from endo_sim_ros.evaluation.deformed_views import touched_psnr
from endo_sim_ros.evaluation.held_out import difference, mean_figures, measure, model_renderer, seen_pixels
from endo_sim_ros.evaluation.lpips import Lpips, WeightsError
from endo_sim_ros.evaluation.measurement import machine, peak_megabytes
from endo_sim_ros.evaluation.splits import STEREO, Split, check_split, right_views, split_views
from endo_sim_ros.evaluation.workers import Finished, News, ray_is_installed, run_in_processes, run_in_ray
from endo_sim_ros.reconstruction import ReconstructionConfig, ScenePoints, Trainer, prepare, reconstruct, scene_points, shrink
from endo_sim_ros.reconstruction.presets import ABLATIONS, preset
from endo_sim_ros.reconstruction.priors.sources import estimate_depth
from endo_sim_ros.reconstruction.scene import TrainingView
from endo_sim_ros.reconstruction.triangulation import points_in_view
from endo_sim_ros.sequences.bag import read_bag
from endo_sim_ros.sequences.folder import read_points
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.sequences.readers import open_sequence
from endo_sim_ros.sequences.recordings import Recording, spread

log = logging.getLogger(__name__)

_SHOWN = 3  # held-out views of a cell of which pictures are kept
_CURVE_VIEWS = 8  # held-out views measured at each moment of a curve
_POINT_VIEWS = 48  # views that structure from motion is done with
_JUDGING, _FEWEST_JUDGES = 10, 50  # one scene point in so many judges depth where nothing better does, if those are enough
_SAME_POINT = 0.1  # of the distance between judging points, up to which another one is the same
_POINT_ERROR = 0.003  # relative error of the depth of points that a recording brings
_PHANTOM = "phantom:"


class Cell(NamedTuple):
    """One training and its measurement."""

    sequence: str
    split: str
    method: str
    seed: int
    options: dict[str, Any]  # of the reconstruction, all of them
    source: str
    train_depth: bool
    mono: bool
    lpips: tuple[str, ...]  # networks whose weights are there
    curve: int

    @property
    def stem(self) -> str:
        return drawing.slug(f"{self.sequence}-{self.split}-{self.method}-{self.seed}")


class Prepared(NamedTuple):
    """A sequence as all its cells use it."""

    frames: list[Frame]  # left; those that no split trains on are as small as is measured
    right: list[Frame]  # the right images as views, for the split of that name
    depth_source: str  # where the reference depth of the frames is from: recorded, stereo matching, or none
    points: ScenePoints  # of structure from motion with all views, like the poses
    judging: np.ndarray | None  # [N, 3] those of them kept from the methods, where there is no exact depth


def evaluate(sequences: Sequence[str], config: EvaluationConfig) -> dict[str, Any]:
    """Train and measure every cell that is not finished yet in the folder of results, and write tables and pictures.

    Args:
        sequences: Each a bag, a recording of a known layout, or `phantom:SEED`; `,name=value` appends options of its reader.

    Returns:
        What `results.json` holds.

    Raises:
        SequenceError, ConfigError: If a sequence, a split or an option is not there. What fails later is in the table, with why.
    """
    names = _names(sequences)
    for split in config.splits:
        check_split(split)
    networks, missing = _networks(config)
    methods = _methods(config)
    given = {"train_depth": config.train_depth, "mono": config.mono, "lpips": networks, "curve": config.curve}
    cells = [
        Cell(name, split, method, seed, options | {"seed": options["seed"] + seed}, source, **given)
        for name, source in names.items()
        for split in config.splits
        for method, options in methods.items()
        for seed in range(config.seeds)
    ]
    for folder in ("cells", "pictures"):
        (config.out / folder).mkdir(parents=True, exist_ok=True)
    finished = {cell.stem: _finished(config.out, cell) for cell in cells}
    open_cells = [cell for cell in cells if finished[cell.stem] is None]
    if len(open_cells) < len(cells):
        log.info("%d of %d cells are finished in %s already", len(cells) - len(open_cells), len(cells), config.out)
    if open_cells:
        for cell, outcome in _run(open_cells, config):
            finished[cell.stem] = _save(config.out, cell, outcome)
    results = {
        "machine": machine(pick_device(config.device)),
        "date": time.strftime("%Y-%m-%d"),
        "missing": missing,
        "cells": [finished[cell.stem] for cell in cells],
    }
    (config.out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    tables.write(results, config.out, config.json)
    return results


# ------------------------------------------------------------------------------------------------- what there is to do


def _names(sequences: Sequence[str]) -> dict[str, str]:
    """A short name for each sequence."""
    if not sequences:
        raise SequenceError(f"give one sequence or more: a bag, a folder, or {_PHANTOM}0")
    names: dict[str, str] = {}
    for source in sequences:
        place = _place(source)[0]
        if not place.startswith(_PHANTOM) and not Path(place).exists():
            raise SequenceError(f"{place}: no such file or folder; give a bag, a recording, or {_PHANTOM}0")
        parts = [place] if place.startswith(_PHANTOM) else list(Path(place).resolve().parts)
        for length in range(1, len(parts) + 1):
            name = "/".join(parts[-length:])
            if name not in names:
                break
        else:
            raise SequenceError(f"{source}: the same sequence twice")
        names[name] = source
    return names


def _methods(config: EvaluationConfig) -> dict[str, dict[str, Any]]:
    """All options of each method, by its name."""
    common = {"device": "auto"} | _values(config.set, "--set", ReconstructionConfig)
    if "preset" in common:
        raise ConfigError("--set preset: methods are named with --presets")
    unlike = {name: dataclasses.asdict(preset(name, **common)) for name in config.presets}
    if config.ablation:
        for name in config.presets:
            for part, overrides in ABLATIONS.get(name, {}).items():
                unlike[f"{name} {part}"] = dataclasses.asdict(preset(name, **{**common, **overrides}))
    return unlike


def _values(items: Iterable[str], where: str, of: type) -> dict[str, Any]:
    """name=value texts as the options of a configuration."""
    known, values = {field.name: field for field in dataclasses.fields(of)}, {}
    for item in items:
        name, equals, text = item.partition("=")
        if not equals or name not in known:
            raise ConfigError(f"{where} {item}: give name=value with a name of {', '.join(known)}")
        values[name] = text if typing.get_type_hints(of)[name] is str else yaml.safe_load(text)
    return values


def _networks(config: EvaluationConfig) -> tuple[tuple[str, ...], dict[str, str]]:
    """The networks of LPIPS that can be used, and why the others cannot."""
    usable, missing = [], {}
    for name in config.lpips:
        try:
            Lpips(name, config.weights)
            usable.append(name)
        except WeightsError as error:
            log.warning("%s", error)
            missing[f"lpips_{name}"] = str(error)
    return tuple(usable), missing


def _finished(out: Path, cell: Cell) -> dict[str, Any] | None:
    """The record of a cell that was finished with the same options."""
    try:
        record = json.loads((out / "cells" / f"{cell.stem}.json").read_text())
        return record if record["error"] is None and record["cell"] == json.loads(json.dumps(cell._asdict())) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


# ---------------------------------------------------------------------------------------------------------- sequences


def _place(source: str) -> tuple[str, list[str]]:
    """The path or name of a sequence, and its options."""
    place, *options = re.split(r",(?=\w+=)", source)
    return place, options


def open_named(source: str) -> Iterable[Frame]:
    """The frames of a sequence as it is named on the command line.

    Raises:
        SequenceError: If there is no such sequence or option.
    """
    place, texts = _place(source)
    if place.startswith(_PHANTOM):
        seed = place.removeprefix(_PHANTOM)
        if not seed.isdecimal():
            raise SequenceError(f"{place}: the synthetic patients have numbers, as {_PHANTOM}0")
        # Half a round: after a whole one the last view would be the first again, and two views one.
        config = PhantomConfig(**{"seed": int(seed), "rounds": 0.5} | _values(texts, place, PhantomConfig))
        return Recording(lambda: phantom_sequence(config), config.frames)
    options = {name: yaml.safe_load(value) for name, _, value in (text.partition("=") for text in texts)}
    if "distortion" in options:
        options["distortion"] = tuple(np.atleast_1d(options["distortion"]).tolist())
    path = Path(place)
    if path.suffix == ".mcap" or (path / "metadata.yaml").is_file() or path.is_dir() and any(path.glob("*.mcap")):
        unknown = set(options) - {"start", "stop", "step"}
        if unknown:
            raise SequenceError(f"{place}: a bag has no option {', '.join(sorted(unknown))}; it has start, stop and step")
        return list(read_bag(path))[slice(*(options.get(name) for name in ("start", "stop", "step")))]
    return open_sequence(path, **options)


def _prepare(cells: Sequence[Cell], bar: Progress) -> Prepared:
    """Read the sequence of these cells; what is the same for all of them is done here, once."""
    source = cells[0].source
    frames, opened = [], open_named(source)
    task = bar.add_task(f"reading {cells[0].sequence}", total=len(opened) if hasattr(opened, "__len__") else None)
    for frame in opened:
        frames.append(frame)
        bar.advance(task)
    bar.remove_task(task)
    frames = [frame for frame in frames if frame.mask is None or frame.mask.any()]
    splits = {cell.split for cell in cells}
    trained: set[int] = set()
    for split in splits:
        with contextlib.suppress(SequenceError):  # too few views for this one: its own cells say so
            trained.update(split_views(split, len(frames)).train)
    task = bar.add_task(f"scene points of {cells[0].sequence}", total=None)
    known = read_points(_place(source)[0])
    points = ScenePoints(*known, _POINT_ERROR) if known else scene_points(frames, _POINT_VIEWS)
    bar.remove_task(task)
    depth_source, matched, judging = "none", frames, None
    recorded = any(frame.depth is not None and (frame.depth > 0).any() for frame in frames)
    if not recorded:
        points, judging = _divided(points)
    if any(frame.right is not None for frame in frames) and (STEREO in splits or not recorded):
        task = bar.add_task(f"stereo matching of {cells[0].sequence}", total=None)
        views = estimate_depth([TrainingView.of(frame) for frame in frames], points, ReconstructionConfig(depth="stereo"))
        matched = [dataclasses.replace(view, depth=view.depth_prior) for view in views]
        bar.remove_task(task)
    if recorded:
        depth_source = "recorded"
    elif matched is not frames:
        frames = [dataclasses.replace(frame, depth=_trusted(match)) for frame, match in zip(frames, matched)]
        if any(frame.depth is not None for frame in frames):
            depth_source = "stereo matching"
    width = max(cell.options["image_width"] for cell in cells)
    paired = STEREO in splits and any(frame.right is not None for frame in frames)
    right = [shrink(frame, width) for frame in right_views(matched)] if paired else []
    small = lambda frame: shrink(dataclasses.replace(frame, right=None, baseline=None, right_K=None), width)
    return Prepared([f if i in trained else small(f) for i, f in enumerate(frames)], right, depth_source, points, judging)


def _divided(points: ScenePoints) -> tuple[ScenePoints, np.ndarray | None]:
    """What the methods get, and the positions [N, 3] of the scene points that their depth is judged by; None of too few.

    A point that was triangulated twice does not count as two.
    """
    judging = np.unique(points.positions, axis=0)[::_JUDGING]
    if len(judging) < _FEWEST_JUDGES:
        return points, None
    tree = cKDTree(judging)
    apart = np.median(tree.query(judging, k=2)[0][:, 1])
    kept = tree.query(points.positions)[0] > _SAME_POINT * apart
    error = np.asarray(points.error)
    return ScenePoints(points.positions[kept], points.colors[kept], error[kept] if error.ndim else points.error), judging


def _trusted(frame: Frame) -> np.ndarray | None:
    """Matched depth [H, W] (m, 0 = none) where half a pixel of disparity is less than a twentieth of it; None if that is nowhere."""
    if frame.depth is None or frame.baseline is None:
        return None
    trusted = np.where(frame.depth < frame.camera.K[0, 0] * frame.baseline / 10, frame.depth, 0)
    return trusted if trusted.any() else None


# ------------------------------------------------------------------------------------------------------------ running


def _devices(config: EvaluationConfig) -> list[str]:
    first = pick_device(config.device)
    if first == "cpu" or config.device not in ("auto", "cuda"):
        devices = [first]
    else:
        devices = [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    return devices * config.workers


def _run(cells: list[Cell], config: EvaluationConfig) -> Iterator[tuple[Cell, Finished]]:
    """Run cells, sequence by sequence, and yield each with its end as it comes."""
    devices = _devices(config)
    with_ray = config.pool == "ray" or config.pool == "auto" and ray_is_installed()
    bar = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with bar, tempfile.TemporaryDirectory(prefix="endo_sim_") as folder:
        task = bar.add_task("cells", total=len(cells))
        for sequence in dict.fromkeys(cell.sequence for cell in cells):
            ours = [cell for cell in cells if cell.sequence == sequence]
            try:
                prepared = _prepare(ours, bar)
            except (ValueError, OSError, RuntimeError) as error:
                log.warning("%s failed: %s", sequence, error)
                for index, cell in enumerate(ours):
                    bar.advance(task)
                    yield cell, Finished(index, error=str(error))
                continue
            if with_ray:
                import ray

                ray.is_initialized() or ray.init(log_to_driver=False, logging_level="ERROR")
                shared = ray.put(prepared)
                events = run_in_ray(_job, [(cell, config.weights, shared) for cell in ours], devices[0] != "cpu", config.workers)
            else:
                file = Path(folder) / f"{drawing.slug(sequence)}.pickle"
                file.write_bytes(pickle.dumps(prepared))
                events = run_in_processes(_job, [(cell, config.weights, file) for cell in ours], devices)
            del prepared
            running: dict[int, TaskID] = {}
            for event in events:
                cell = ours[event.index]
                if isinstance(event, News):
                    done, total, text = event.message
                    if event.index not in running:
                        running[event.index] = bar.add_task("")
                    what = f"  {cell.sequence} {cell.split} {cell.method} seed {cell.seed}: {text}"
                    bar.update(running[event.index], completed=done, total=total, description=what)
                    continue
                if event.index in running:
                    bar.remove_task(running.pop(event.index))
                bar.advance(task)
                if event.error:
                    log.warning("%s, %s, %s, seed %d failed: %s", *cell[:4], event.error)
                yield cell, event


def _save(out: Path, cell: Cell, outcome: Finished) -> dict[str, Any]:
    """Write what a cell gave, and return its record."""
    result = outcome.result or {}
    pictures = {}
    for name, data in result.pop("pictures", {}).items():
        pictures[name] = f"pictures/{cell.stem}-{name}.jpg"
        (out / pictures[name]).write_bytes(data)
    record = {"cell": cell._asdict(), "error": outcome.error, "pictures": pictures, **result}
    file = out / "cells" / f"{cell.stem}.json"
    partial = file.with_suffix(".part")
    partial.write_text(json.dumps(record, indent=1) + "\n")
    partial.replace(file)
    return json.loads(file.read_text())


# ----------------------------------------------------------------------------------------- in the process of a training


@functools.lru_cache(maxsize=1)
def _load(file: Path) -> Prepared:
    return pickle.loads(file.read_bytes())


@functools.lru_cache(maxsize=2)
def _network(name: str, weights: Path | None, device: str) -> Lpips:
    return Lpips(name, weights, device)


@functools.lru_cache(maxsize=1)
def _warm_up(device: str) -> None:
    """Load or compile every kernel, which is no part of the time of a training."""
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    camera, poses = Camera(np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1]]), 64, 48), np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.005
    frames = [Frame(i, image, camera.at(pose), depth=np.full((48, 64), 0.1, np.float32)) for i, pose in enumerate(poses)]
    with contextlib.suppress(SequenceError):  # they need not make a scene
        reconstruct(frames, ReconstructionConfig(iterations=3, max_gaussians=500, depth="topic", device=device))


def _job(argument: tuple, device: str, report: Callable[[Any], None]) -> dict[str, Any]:
    """Train and measure one cell; what it returns is written by the process that asked for it, which may be on another host."""
    cell, weights, prepared = argument
    if isinstance(prepared, Path):
        prepared = _load(prepared)
    config = ReconstructionConfig.from_mapping(cell.options | {"device": device})
    split = split_views(cell.split, len(prepared.frames))
    views = [prepared.frames[index] for index in split.train]
    if not (cell.train_depth and prepared.depth_source == "recorded"):
        views = [dataclasses.replace(view, depth=None) for view in views]
    if cell.mono or split.right:
        views = [dataclasses.replace(view, right=None, baseline=None, right_K=None) for view in views]
    held_out = [shrink(frame, config.image_width) for frame in _held_out(prepared, split)]
    report((0, 1, "warming up"))
    _warm_up(device)
    training: dict[str, Any] = {}

    def train() -> None:
        training.update(_train(views, config, prepared.points, spread(held_out, _CURVE_VIEWS), cell.curve, report))

    memory = peak_megabytes(train, device)
    model, drift = training.pop("model"), training.pop("drift")
    report((0, len(held_out), "measuring"))
    networks = [_network(name, weights, device) for name in cell.lpips]
    seen_by = [shrink(prepared.frames[index], config.image_width) for index in split.train]
    renderer = model_renderer(model, device)
    shown = set(spread(range(len(held_out)), _SHOWN))
    # Without reference depth that of the model tells what was seen.
    known = all(frame.depth is not None for frame in [*held_out, *seen_by])
    surfaces = [(view.camera, view.depth if known else renderer.render(view.camera)[1], view.mask) for view in seen_by]

    def of_view(index: int, image: np.ndarray, depth: np.ndarray) -> tuple[dict[str, float], dict[str, bytes]]:
        frame, number = held_out[index], split.held_out[index]
        seen = seen_pixels(frame.camera, frame.depth if known else depth, surfaces)
        found = measure(image, depth, frame, seen, networks, prepared.judging)
        row = {"view": number} | {name: value for name, value in found.items() if np.isfinite(value)}
        return row, _pictures(number, image, depth, frame) if index in shown else {}

    touched = {"psnr_touched": touched_psnr(model, [view.camera for view in seen_by], device)}
    touched = {name: value for name, value in touched.items() if np.isfinite(value)}
    rows, pictures = [], {}
    with ThreadPoolExecutor(cpu_threads()) as pool:  # measuring takes longer than drawing
        waiting = deque()
        for index, frame in enumerate(held_out):
            waiting.append(pool.submit(of_view, index, *renderer.render(frame.camera, light=drift.at(model.light, frame.stamp_ns))))
            while len(waiting) > 2 * cpu_threads() or waiting and index == len(held_out) - 1:
                row, new = waiting.popleft().result()
                rows.append(row)
                pictures |= new
                report((len(rows), len(held_out), "measuring"))
    return {
        "machine": machine(device),
        "size": [held_out[0].camera.width, held_out[0].camera.height],
        "train": split.train,
        "held_out": len(held_out),
        "masked": any(frame.mask is not None and not frame.mask.all() for frame in held_out),
        "depth_source": "none" if split.right else prepared.depth_source,
        "given": [
            *["right images"] * any(view.right is not None for view in views),
            *["recorded depth"] * any(view.depth is not None for view in views),
        ],
        "reference_at_points": _reference_at_points(held_out, prepared.judging),
        "seen_by": "reference" if known else "model",
        "figures": mean_figures(rows) | touched | {"seconds": training["seconds"], "gaussians": len(model), "megabytes": memory},
        "views": rows,
        "curve": training["curve"],
        "pictures": pictures,
    }


def _held_out(prepared: Prepared, split: Split) -> list[Frame]:
    if not split.right:
        return [prepared.frames[index] for index in split.held_out]
    if not prepared.right:
        raise SequenceError("split stereo: the sequence has no right images")
    return prepared.right


def _reference_at_points(held_out: list[Frame], judging: np.ndarray | None) -> float | None:
    """How far the reference depth is off at the scene points that judge, metres; None if there are not both."""
    if judging is None:
        return None
    judged = [frame for frame in held_out if frame.depth is not None]
    off = [metrics.depth_at_points(frame.depth, *points_in_view(frame.camera, judging), frame.mask) for frame in judged]
    off = [value for value in off if np.isfinite(value)]
    return float(np.mean(off)) if off else None


def _train(
    views: list[Frame], config: ReconstructionConfig, points: ScenePoints, probes: list[Frame], moments: int, report: Callable
) -> dict[str, Any]:
    """Train; the seconds that it took, without those of the measurements for the curve."""

    def now() -> float:
        if config.device != "cpu":
            torch.cuda.synchronize(config.device)
        return time.perf_counter()

    curve, start, away = [], now(), 0.0
    trainer = Trainer(prepare(views, config, points, lambda stage, done, total: report((done, max(total, 1), stage))), config)
    iterations = trainer.config.iterations
    # Quality changes fastest in the beginning.
    due = sorted({round(iterations * 50 ** (i / max(moments - 1, 1) - 1)) for i in range(moments)})

    def on_progress(progress) -> None:
        nonlocal away
        report((progress.iteration, iterations, f"{progress.gaussians} Gaussians"))
        if not due or progress.iteration < due[0]:
            return
        while due and progress.iteration >= due[0]:
            due.pop(0)
        paused = now()
        model, drift = trainer.model, trainer.drift
        renderer = model_renderer(model, config.device)
        drawn = lambda probe: renderer.render(probe.camera, light=drift.at(model.light, probe.stamp_ns))[0]
        pairs = [(drawn(probe), probe.image, probe.mask) for probe in probes]
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
    return {"model": model, "drift": trainer.drift, "seconds": seconds, "curve": curve}


def _pictures(view: int, image: np.ndarray, depth: np.ndarray, frame: Frame) -> dict[str, bytes]:
    """Pictures of a held-out view as JPEG files, by name."""
    reference = depth if frame.depth is None else frame.depth
    near, far = np.percentile(reference[reference > 0], [1, 99]) if (reference > 0).any() else (0.0, 1.0)
    pictures = {
        "reference": frame.image,
        "rendered": image,
        "difference": difference(image, frame.image) * (1 if frame.mask is None else (frame.mask > 0)[..., None]),
        "depth": drawing.color_depth(depth, near, far),
    }
    if frame.depth is not None:
        pictures["reference_depth"] = drawing.color_depth(frame.depth, near, far)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 92]
    return {
        f"{view:04d}-{name}": cv2.imencode(".jpg", cv2.cvtColor(picture.astype(np.uint8), cv2.COLOR_RGB2BGR), quality)[1].tobytes()
        for name, picture in pictures.items()
    }
