"""How fast the environments are: `endo-sim bench environments`."""

import gc
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from endo_sim_ros.core.device import pick_device, return_freed_memory, single_threaded_torch
from endo_sim_ros.evaluation.measurement import Row, machine, median_seconds, report
from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.scenes import Scene, load_scene
from endo_sim_ros.learning.task_batch import Observations, TaskBatch

_STEPS = 25  # of random actions in one measurement


@single_threaded_torch()
def bench_environments(
    json_file: Path | None,
    task: str = "retraction",
    environments: tuple[int, ...] = (1, 64),
    device: str = "auto",
    repeats: int = 5,
    gpus: int = 0,
) -> None:
    """Print, and if asked for write, how many steps per second the environments take together.

    Args:
        json_file: Where to write the rows.
        task: Name of the task.
        environments: Numbers of environments stepped together.
        device: Compute device.
        repeats: Measurements, of which the median counts.
        gpus: Workers of Ray with the greatest number of environments each, beside one such worker; 0 = none.

    Raises:
        ValueError: If a number of environments is not positive, or there is none, or there are not so many GPUs, or cores where none is.
        RuntimeError: If Ray is needed, but not installed.
    """
    if not environments or min(environments) < 1:
        raise ValueError(f"give numbers of environments of at least 1, got {' '.join(map(str, environments)) or 'none'}")
    device, scene, rows = pick_device(device), load_scene(), []
    peer = f"{environments[0]} environment{'s' * (environments[0] > 1)}"
    kinds: dict[str, tuple[Observations, SightConfig]] = {
        "state observations": ("state", SightConfig()),
        "image observations": ("image", SightConfig(instrument=False)),
        "images with the tool": ("image", SightConfig()),
        "both eyes and labels": ("image", SightConfig(eyes=2, segmentation=True)),
    }
    measured: dict[str, list[float]] = {}
    for name, (observations, sight) in kinds.items():
        rates = measured[name] = [_rate(task, scene, count, observations, sight, device, repeats) for count in environments]
        for i, (count, rate) in enumerate(zip(environments, rates)):
            compared = (None, None) if i == 0 else (rate / rates[0], peer)
            if sight.instrument and observations == "image":
                compared = rate / measured["image observations"][i], "without the tool"
            rows.append(Row(f"{name}, {count} environment{'s' * (count > 1)}", rate, "steps/s", *compared))
    for count in environments:
        named = f"{count} environment{'s' * (count > 1)}"
        milliseconds, megabytes = _reset_and_memory(task, scene, count, device, repeats)
        rows.append(Row(f"reset of each of {named}", milliseconds, "ms"))
        rows.append(Row(f"memory of each of {named}, images with the tool", megabytes, "MB"))
    for name in ("state observations", "images with the tool") if gpus else ():
        count = max(environments)
        alone, together = (_workers_rate(task, count, workers, *kinds[name], repeats) for workers in (1, gpus))
        one = f"1 worker with {count}"
        rows.append(Row(f"{name}, {one}", alone, "steps/s"))
        rows.append(Row(f"{name}, {gpus} workers with {count} each", together, "steps/s", together / alone, one))
    report(f"Environments: {task} on {machine(device)}", rows, json_file)


def _workers_rate(task: str, count: int, workers: int, observations: Observations, sight: SightConfig, repeats: int) -> float:
    """Steps per second of the environments of all workers together, gathered here; the tools wander above the tissue."""
    from endo_sim_ros.learning.joined import JoinedEnvironments

    environment = JoinedEnvironments(task, workers * count, workers=workers, observations=observations, **asdict(sight))
    actions = np.random.default_rng(0).uniform(-1, 1, (_STEPS, *environment.action_space.sample().shape))

    def episode() -> None:
        environment.reset(seed=0)
        for step in actions:
            environment.step(step)

    try:
        return actions.shape[0] * actions.shape[1] / median_seconds(episode, repeats, warm_up=1)
    finally:
        environment.close()


def _rate(task: str, scene: Scene, count: int, observations: Observations, sight: SightConfig, device: str, repeats: int) -> float:
    """Steps per second of all environments together, the tools at work in the tissue."""
    batch, rng = TaskBatch(task, scene, count, observations, sight=sight, device=device), np.random.default_rng(0)
    everyone = range(count)

    def episode() -> None:
        batch.reset(everyone, [np.random.default_rng(b) for b in everyone])
        batch.task.tip[:] = 0  # at the tissue
        for _ in range(_STEPS):
            actions = rng.uniform(-1, 1, (count, batch.action_size))
            actions[:, 3::4] = batch.task.working_fourth
            batch.step(actions)

    return count * _STEPS / median_seconds(episode, repeats, device, warm_up=1)


def _reset_and_memory(task: str, scene: Scene, count: int, device: str, repeats: int) -> tuple[float, float]:
    """Milliseconds that an environment's part of a reset of all takes, and its megabytes on the device, with pictures of the tool."""
    before = _used(device)
    batch = TaskBatch(task, scene, count, "image", device=device)
    everyone, rngs = range(count), [np.random.default_rng(b) for b in range(count)]
    batch.reset(everyone, rngs)
    batch.step(np.zeros((count, batch.action_size)))
    batch.images()
    megabytes = (_used(device) - before) / count / 1e6
    return 1e3 * median_seconds(lambda: batch.reset(everyone, rngs), repeats, device) / count, megabytes


def _used(device: str) -> int:
    """Bytes that this process takes on a device; on a GPU those that all take."""
    gc.collect()
    if device.startswith("cuda"):
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info(device)
        return total - free
    return_freed_memory()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
