"""A leaderboard that repeats: policies play the same unseen episodes of a task, and a table and a page say how well.

Seeds are fixed, and scenes are the same for everybody who names no others: synthetic patients that no default trains on. Results are
added to those that the folder has, so that a page may hold several tasks, and policies from several machines.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from html import escape
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from endo_sim_ros.core import drawing
from endo_sim_ros.core.folders import make_writable, written_whole
from endo_sim_ros.core.plugins import told_where
from endo_sim_ros.learning.config import BenchmarkConfig, Randomisation, SightConfig
from endo_sim_ros.learning.policies import Policy, make_policy
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.task_batch import TaskBatch, usable
from endo_sim_ros.learning.tasks import find_task
from endo_sim_ros.learning.train import TESTED_FROM, play
from endo_sim_ros.physics import MotionConfig

_RESULTS, _PAGE = "benchmark.json", "benchmark.html"
_FILMED = 8  # episodes that the video shows

CONDITIONS: dict[str, tuple[Randomisation, MotionConfig]] = {
    "as usual": (Randomisation(), MotionConfig()),
    "light": (Randomisation(light=0.5), MotionConfig()),
    "texture": (Randomisation(texture=0.5), MotionConfig()),
    "endoscope": (Randomisation(camera_position=0.002, camera_angle=2.0), MotionConfig()),
    "instrument": (Randomisation(tool=1.0, metal=0.5, lamp=0.005), MotionConfig()),
    "stiffness": (Randomisation(stiffness=0.5), MotionConfig()),
    "breath": (Randomisation(), MotionConfig(breathing=0.004)),
}
"""What episodes are like, by its name; all but the first are of the robustness table."""


@dataclass(frozen=True)
class Result:
    """Episodes of one policy under one condition in one scene."""

    task: str
    policy: str
    scene: str
    condition: str
    episodes: int
    solved: int
    mean_return: float
    mean_steps: float
    complete: bool = True  # else something ended them before all that were wanted
    training: str = ""  # what is to be told of the policy's


def benchmark(
    out: Path,
    policies: Sequence[str],
    scenes: Sequence[str],
    config: BenchmarkConfig,
    device: str = "auto",
    make: Callable[[str, str, int, str], Policy] = make_policy,
) -> list[Result]:
    """Let policies play, add what came out to the table of a folder, and draw its page.

    Args:
        out: Folder of benchmark.json, benchmark.html and a video for each task and policy.
        policies: Each as `make_policy` takes it.
        scenes: Each once, as `load_scene` takes it. One in which the task cannot take place is left out, and it is said why.
        config: Options.
        device: Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N.
        make: What makes a policy of its name, as `make_policy` does. One that has an attribute ``alone`` that is true plays one episode
            after the other. What it raises ends all, and the episodes before are kept.

    Returns:
        The new results.

    Raises:
        ValueError: If there is no such task, policy or scene, a scene is given twice, none is left, the folder has other data or takes
            no files, or a policy does not fit the task.
        RuntimeError: If a policy needs a library that is not installed, or a class of your own raises.
    """
    task = find_task(config.task).name
    drawing.check_video()
    before = read_results(out)
    loaded = {policy: make(policy, config.task, config.episodes, device) for policy in policies}  # before the long work
    conditions = CONDITIONS if config.robustness else {name: CONDITIONS[name] for name in list(CONDITIONS)[:1]}

    kinds = {(policy.actions, policy.sight): policy for policy in loaded.values()}.values()  # no scene tells others apart

    def playable(scene: Scene) -> Scene:  # known before the long work, for a tenth of a second of each
        for policy in kinds:
            for randomisation, motion in conditions.values():
                _batch(config.task, scene, 1, policy, randomisation, motion, device, images=True)
        return scene

    names, places = usable(scenes, playable)
    found: list[Result] = []
    make_writable(out)
    with Progress() as bar:
        progress = bar.add_task(config.task, total=len(loaded) * len(names) * len(conditions))
        for name, policy in loaded.items():
            for scene, place in zip(names, places):
                for condition, (randomisation, motion) in conditions.items():
                    bar.update(progress, description=f"{name}, {scene}, {condition}")
                    at_once = 1 if getattr(policy, "alone", False) else config.episodes
                    batch, played = _batch(config.task, place, at_once, policy, randomisation, motion, device), []
                    try:
                        for seed in range(0, config.episodes, at_once):
                            played.append(_play(name, batch, policy, TESTED_FROM + seed + np.arange(at_once)))
                            bar.advance(progress, at_once / config.episodes)
                    finally:
                        if played:
                            result = _result(task, name, scene, condition, played, config.episodes)
                            found.append(replace(result, training=getattr(policy, "training", "")))
                        del batch
                        before = _merge(before, found)
                        _save(out, before)
            _film(out, config, name, policy, places[0], device, make)
            _save(out, before)  # with the film
    return found


def read_results(folder: Path) -> list[Result]:
    """The table of a folder; empty if there is none yet.

    Raises:
        ValueError: If there is one, but damaged.
    """
    path = folder / _RESULTS
    if not path.exists():
        return []
    try:
        rows = json.loads(path.read_text("utf8"))
        return [Result(**{name: value for name, value in row.items() if name != "first_seed"}) for row in rows]  # which older ones tell
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: not the results of `endo-sim benchmark` ({error}); choose another folder") from error


def _merge(before: Sequence[Result], found: Sequence[Result]) -> list[Result]:
    """Results by what they are of, newer ones in the place of older ones, but of complete ones no incomplete one."""
    merged: dict[tuple[str, ...], Result] = {}
    for result in (*before, *found):
        key = (result.task, result.policy, result.scene, result.condition)
        old = merged.get(key)
        if old is None or result.complete or (not old.complete and result.episodes >= old.episodes):
            merged[key] = result
    return list(merged.values())


def _result(
    task: str, policy: str, scene: str | Path, condition: str, played: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], wanted: int
) -> Result:
    """Of what `play` returned, once or more."""
    returns, solved, steps = map(np.concatenate, zip(*played))
    means, complete = (float(returns.mean()), float(steps.mean())), len(solved) == wanted
    return Result(task, policy, str(scene), condition, len(solved), int(solved.sum()), *means, complete=complete)


def _save(folder: Path, results: Sequence[Result]) -> None:
    """Write the table, and the page with the films that there are."""
    with written_whole(folder / _RESULTS) as partial:
        partial.write_text(json.dumps([asdict(result) for result in results], indent=1) + "\n", "utf8")
    (folder / _PAGE).write_text(_page(results, folder), "utf8")


def _batch(
    task: str, scene: Scene, count: int, policy: Policy, randomisation: Randomisation, motion: MotionConfig, device: str, **options: Any
) -> TaskBatch:
    """Episodes for a policy, with the observations that it takes."""
    observations = "state" if policy.sight is None else "sensors"
    sight = options.pop("sight", policy.sight or SightConfig())
    return TaskBatch(task, scene, count, observations, randomisation, sight, device, actions=policy.actions, motion=motion, **options)


def _play(name: str, *given: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `play` returns; what does not fit is told with the name of the policy, of which there may be several."""
    try:
        with told_where():
            return play(*given)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _film(out: Path, config: BenchmarkConfig, name: str, policy: Policy, scene: Scene, device: str, make: Callable[..., Policy]) -> None:
    """Write a video of the first episodes, side by side, each until its end; of a policy that plays alone, of the first."""
    alone = getattr(policy, "alone", False)
    count = 1 if alone else min(_FILMED, config.episodes)
    policy = policy if alone else make(name, config.task, count, device)
    shown = policy.sight or SightConfig(image_width=config.image_width)
    batch = _batch(config.task, scene, count, policy, *CONDITIONS["as usual"], device, images=True, sight=shown)
    frames: list[np.ndarray] = []
    running = np.ones(count, bool)

    def look(ended: np.ndarray) -> None:
        images = batch.images()
        last = frames[-1] if frames else images
        frames.append(np.where(running[:, None, None, None], images, last))
        running[ended] = False

    _play(name, batch, policy, TESTED_FROM + np.arange(count), look)
    columns = (count + 1) // 2
    blank = [np.zeros_like(frames[0][0])] * (2 * columns - count)
    rows = ([*frame, *blank] for frame in frames)
    tiled = (np.vstack([np.hstack(row[:columns]), np.hstack(row[columns:])]) for row in rows)
    drawing.write_video(out / _video(batch.task.name, name), tiled, round(1 / batch.task.physics().step_duration))


def _video(task: str, policy: str) -> str:
    return f"{drawing.slug(task)}-{drawing.slug(policy)}.mp4"


def interval(solved: int, episodes: int) -> tuple[float, float]:
    """Where the true share of solved episodes lies with 95 %: Wilson's score interval."""
    z, share = 1.96, solved / episodes
    middle, half = share + z**2 / (2 * episodes), z * sqrt(share * (1 - share) / episodes + (z / (2 * episodes)) ** 2)
    return max((middle - half) / (1 + z**2 / episodes), 0.0), (middle + half) / (1 + z**2 / episodes)


def summarise(results: Sequence[Result], condition: str = "") -> list[Result]:
    """Over all scenes: one result for each task, policy and condition, those that solve most first."""
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        if condition in ("", result.condition):
            groups.setdefault((result.task, result.policy, result.condition), []).append(result)
    merged = []
    for each in groups.values():
        weights = [result.episodes for result in each]
        alike = len(set(weights)) == 1  # else rows with as many episodes may be of others
        merged.append(
            replace(
                each[0],
                scene=", ".join(result.scene if alike else f"{result.scene} ({result.episodes})" for result in each),
                complete=all(result.complete for result in each),
                episodes=sum(weights),
                solved=sum(result.solved for result in each),
                mean_return=float(np.average([result.mean_return for result in each], weights=weights)),
                mean_steps=float(np.average([result.mean_steps for result in each], weights=weights)),
            )
        )
    return sorted(merged, key=lambda result: (result.task, -result.solved / result.episodes, -result.mean_return))


def table(results: Sequence[Result]) -> list[list[str]]:
    """The leaderboard as rows of text, the first being its head."""
    rows = [["task", "policy", "solved", "95 %", "mean return", "mean steps", "episodes", "scenes"]]
    for result in summarise(results, next(iter(CONDITIONS))):
        low, high = interval(result.solved, result.episodes)
        numbers = [f"{result.solved / result.episodes:.0%}", f"{low:.0%} to {high:.0%}", f"{result.mean_return:.2f}"]
        episodes = f"{result.episodes}{'' if result.complete else ', interrupted'}"
        policy = ", ".join(filter(None, (result.policy, result.training)))
        rows.append([result.task, policy, *numbers, f"{result.mean_steps:.0f}", episodes, result.scene])
    return rows


def robustness(results: Sequence[Result]) -> list[list[str]]:
    """Shares of solved episodes by condition, as rows of text, the first being their head; empty where only one was played."""
    merged = {(each.task, each.policy, each.condition): each for each in summarise(results)}
    conditions = [name for name in CONDITIONS if any(name == condition for *_, condition in merged)]
    if len(conditions) < 2:
        return []
    rows = [["task", "policy", *conditions]]
    for task, policy in dict.fromkeys(key[:2] for key in merged):
        found = [merged.get((task, policy, condition)) for condition in conditions]
        rows.append([task, policy, *(f"{each.solved / each.episodes:.0%}" if each else "" for each in found)])
    return rows


def _page(results: Sequence[Result], out: Path) -> str:
    """The tables and the videos as a page."""

    def drawn(rows: list[list[str]]) -> str:
        head, *body = rows
        line = lambda cells, tag: "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"
        return f"<table>{line(head, 'th')}{''.join(line(row, 'td') for row in body)}</table>"

    parts = ["<h2>Leaderboard</h2>", drawn(table(results)), f"<p>Seeds of the episodes in each scene: from {TESTED_FROM} on.</p>"]
    if rows := robustness(results):
        kinds = "; ".join(f"{escape(name)}: {escape(_differs(*what))}" for name, what in list(CONDITIONS.items())[1:])
        parts += ["<h2>Robustness</h2>", drawn(rows), f"<p>{kinds}.</p>"]
    for result in summarise(results, next(iter(CONDITIONS))):
        video = _video(result.task, result.policy)
        if (out / video).exists():
            shown = f"<video src='{escape(video)}' autoplay loop muted controls></video>"
            parts.append(f"<h2>{escape(result.task)}: {escape(result.policy)}</h2>{shown}")
    style = "body{font:15px/1.5 system-ui,sans-serif;max-width:1200px;margin:2rem auto;padding:0 1rem;color-scheme:light dark}"
    style += "table{border-collapse:collapse}td,th{padding:.25rem .7rem;text-align:left;border-bottom:1px solid #8884}video{max-width:100%}"
    head = f"<meta charset=utf-8><title>Benchmark of policies</title><style>{style}</style>"
    return f"<!doctype html><html lang=en><head>{head}</head><body><h1>Benchmark of policies</h1>{''.join(parts)}</body></html>\n"


def _differs(randomisation: Randomisation, motion: MotionConfig) -> str:
    """The options that are not the default, in words."""
    parts = [(asdict(part), asdict(type(part)())) for part in (randomisation, motion)]
    return ", ".join(f"{name} {value:g}" for part, usual in parts for name, value in part.items() if value != usual[name])
