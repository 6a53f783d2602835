"""Train a small policy by the cross-entropy method, many episodes at once: `endo-sim train`."""

import json
import logging
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from rich.progress import Progress

from endo_sim_ros.core.device import single_threaded_torch
from endo_sim_ros.learning.actions import Actions, Contact
from endo_sim_ros.learning.config import PPOConfig, Randomisation, TrainingConfig
from endo_sim_ros.learning.policies import NetworkPolicy, Policy
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.physics import MotionConfig

log = logging.getLogger(__name__)

TESTED_FROM = 1_000_000
"""The first seed of episodes that are only tested on."""
_CHOSEN_FROM = 2_000_000  # the first seed of those by which a training chooses its best policy


def play(
    batch: TaskBatch, policy: Policy, seeds: np.ndarray, look: Callable[[np.ndarray], None] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One episode in each copy of a batch: returns [B], success [B], and lengths [B].

    Args:
        batch: Its observations are those that the policy takes.
        policy: What acts.
        seeds: Of the episodes [B].
        look: Called after the beginning and each step, with what has ended [B].
    """
    everyone = range(batch.count)
    batch.reset(everyone, [np.random.default_rng(int(seed)) for seed in seeds])
    policy.reset(everyone)
    returns, success, lengths = np.zeros(batch.count), np.zeros(batch.count, bool), np.zeros(batch.count, int)
    running = np.ones(batch.count, bool)
    observations = batch.observe()
    if look is not None:
        look(~running)
    while running.any():
        observations, outcome = batch.step(policy.act(observations))
        returns += outcome.reward * running
        lengths += running
        success |= outcome.success & running
        running &= ~(outcome.terminated | outcome.truncated)
        if look is not None:
            look(~running)
    return returns, success, lengths


def measure_policy(batch: TaskBatch, policy: Policy) -> dict[str, float]:
    """Mean return and success rate in episodes that no training sees, one in each copy of a batch."""
    returns, success, _ = play(batch, policy, _CHOSEN_FROM + np.arange(batch.count))
    return {"test_return": float(returns.mean()), "test_success": float(success.mean())}


class Best:
    """Keeps the policy that solves most test episodes, and of several the one with the greatest return: learning may get worse again.

    As it is chosen by these episodes, it solves somewhat fewer of others.

    Attributes:
        policy: That policy.
        curve: The learning curve so far, of what trains; it is also what a training that is interrupted leaves.
    """

    policy: NetworkPolicy

    def __init__(self) -> None:
        self._figures = (-np.inf, -np.inf)
        self.curve: list[dict[str, float]] = []

    def offer(self, policy: NetworkPolicy, result: dict[str, float]) -> None:
        """Keep a policy, with what `measure_policy` found, if it is the best so far."""
        if (figures := (result["test_success"], result["test_return"])) > self._figures:
            self.policy, self._figures = policy, figures


@single_threaded_torch()
def train(
    task: str,
    scene: Scene,
    config: TrainingConfig,
    randomisation: Randomisation = Randomisation(),
    device: str = "auto",
    actions: Actions = "cartesian",
    contact: Contact = "point",
    motion: MotionConfig = MotionConfig(),
    best: Best | None = None,
) -> tuple[NetworkPolicy, list[dict[str, float]]]:
    """Train a policy.

    With ``best`` it is put there as it learns, for those whom an interrupt may reach before the end.

    Returns:
        The best policy of all generations, see `Best`, and the learning curve: for each generation, the first being the untrained
        policy, the number of training episodes so far, returns of population and elite, test return and success rate, and seconds.
    """
    hidden = [config.hidden] if config.hidden else []
    rng = np.random.default_rng([config.seed, 0xCE])
    make = partial(TaskBatch, task, scene, randomisation=randomisation, device=device, actions=actions, contact=contact, motion=motion)
    batch, testing = make(config.population), make(config.test_episodes)
    size = sum(rows * columns for rows, columns in NetworkPolicy.sizes(task, hidden, actions))
    mean, deviation = np.zeros(size), np.full(size, config.spread)
    elite_count = max(round(config.elite * config.population), 2)
    kept, began = Best() if best is None else best, time.monotonic()
    with Progress() as bar:
        progress = bar.add_task("training", total=config.generations)
        for generation in range(config.generations + 1):
            scores = np.zeros(config.population)
            elite = np.zeros(1, int)
            if generation:
                vectors = mean + deviation * rng.standard_normal((config.population, size))
                policy = NetworkPolicy.from_vectors(task, hidden, vectors, actions)
                for _ in range(config.episodes):
                    scores += play(batch, policy, np.full(config.population, rng.integers(TESTED_FROM)))[0] / config.episodes
                elite = np.argsort(-scores, kind="stable")[:elite_count]
                # Noise keeps the Gaussian from collapsing before it has arrived; without it the last 30 % of the generations settle.
                noise = 0.3 * config.spread * max(1 - generation / (0.7 * config.generations), 0.0)
                mean, deviation = vectors[elite].mean(0), vectors[elite].std(0) + noise
            tested = NetworkPolicy.from_vectors(task, hidden, mean, actions)
            result = measure_policy(testing, tested)
            kept.offer(tested, result)
            kept.curve.append(
                {
                    "generation": generation,
                    "episodes": generation * config.episodes * config.population,
                    "population_return": float(scores.mean()),
                    "elite_return": float(scores[elite].mean()),
                    **result,
                    "seconds": time.monotonic() - began,
                }
            )
            bar.update(progress, completed=generation, description=f"solved {result['test_success']:.0%}")
    return kept.policy, kept.curve


def save_training(folder: Path, policy: NetworkPolicy, curve: list[dict[str, float]], config: TrainingConfig | PPOConfig) -> None:
    """Write policy.npz, curve.json and curve.png."""
    folder.mkdir(parents=True, exist_ok=True)
    policy.save(folder / "policy.npz")
    (folder / "curve.json").write_text(json.dumps({"task": policy.task, "config": asdict(config), "curve": curve}, indent=1) + "\n")
    draw_curve(folder / "curve.png", policy.task, curve)


def draw_curve(path: Path, task: str, curve: list[dict[str, float]]) -> None:
    """Write the success rate over training episodes as a picture, where matplotlib is installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        log.info("%s is not drawn without matplotlib; pip install 'endo_sim_ros[report]'", path)
        return
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot([point["episodes"] for point in curve], [point["test_success"] for point in curve])
    axes.set(title=task, xlabel="training episodes", ylabel="test episodes solved", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=100)
