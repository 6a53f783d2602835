"""Environments of several scenes as one, in this process or in workers of Ray: all GPUs of a machine, or of many machines."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

from endo_sim_ros.learning.environments import VectorTaskEnvironment, seeds_and_mask
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.task_batch import Observed

Wait = Callable[[], Any]
"""Waits for what a call returns."""


class JoinedEnvironments(gymnasium.vector.VectorEnv):
    """Environments of one task in several scenes as one, which workers step at the same time.

    Environment i, with seed s, is the single one with seed s + i in its scene: the first are in the first scene, and so on. With
    workers, each has as many of each scene.

    Args:
        task: As for :class:`TaskEnvironment`.
        num_envs: How many in all.
        scenes: Each as for :class:`TaskEnvironment`.
        workers: Processes of Ray among which they are divided; each has a GPU of its own where Ray knows of GPUs, else a core. Without
            a cluster, one is begun on this machine: call ``ray.init`` before to choose. 0 = this process.
        options: Other arguments of :class:`VectorTaskEnvironment`, by their names.

    Raises:
        ValueError: If an argument cannot be used, there are fewer environments than parts, pictures of the scenes differ in size, or the
            cluster is too small.
        RuntimeError: If Ray is needed, but not installed.
    """

    metadata = VectorTaskEnvironment.metadata

    def __init__(
        self, task: str, num_envs: int = 1, scenes: Sequence[Scene | Path | str | None] = (None,), workers: int = 0, **options: Any
    ):
        if workers < 0:
            raise ValueError(f"workers is {workers}; give a number of processes, or 0 for this one")
        if num_envs < max(workers, 1) * len(scenes) or not scenes:
            raise ValueError(f"{num_envs} environments cannot be divided among {max(workers, 1)} workers with {len(scenes)} scenes each")
        shares = _shares(num_envs, workers) if workers else _shares(num_envs, len(scenes))
        if workers:
            ray, resource = _ray(workers)
            make = [partial(JoinedEnvironments, task, share, scenes, **options) for share in shares]
            self._parts = [_Worker(ray, each, resource) for each in make]
        else:
            make = [partial(VectorTaskEnvironment, task, share, scene=scene, **options) for share, scene in zip(shares, scenes)]
            self._parts = [_Here(each) for each in make]
        spaces = [part.begin("spaces")() for part in self._parts]
        self.single_observation_space, self.single_action_space = spaces[0]
        if other := [scene for scene, each in zip(scenes, spaces) if each != spaces[0]]:
            raise ValueError(f"the scene {other[0]} has pictures of another size than {scenes[0]}")
        self.num_envs, self.render_mode = num_envs, options.get("render_mode")
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        bounds = np.cumsum([0, *shares]).tolist()
        self._own = [slice(*pair) for pair in zip(bounds, bounds[1:])]

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, np.ndarray]]:
        """As `VectorTaskEnvironment.reset`."""
        seeds, mask = seeds_and_mask(self.num_envs, seed, options)
        return _joined(self._all("reset", lambda own: {"seed": seeds[own], "options": {"reset_mask": mask[own]}}))

    def step(self, actions: np.ndarray) -> tuple[Observed, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """As `VectorTaskEnvironment.step`."""
        actions, shape = np.asarray(actions, np.float64), (self.num_envs, *self.single_action_space.sample().shape)
        if actions.shape != shape:
            raise ValueError(f"{self.num_envs} environments need as many actions, of {shape[1]} numbers, got the shape {actions.shape}")
        if not np.isfinite(actions).all():  # before any part takes its step
            wrong = int((~np.isfinite(actions)).any(1).argmax())
            raise ValueError(f"the action of environment {wrong} is not finite: {actions[wrong].tolist()}; has learning diverged?")
        return _joined(self._all("step", lambda own: {"actions": actions[own]}))

    def renew(self, episodes: np.ndarray) -> Observed:
        """As `VectorTaskEnvironment.renew`."""
        return _joined(self._all("renew", lambda own: {"episodes": _within(episodes, own)}))

    def render(self) -> tuple[np.ndarray, ...] | None:
        """As `VectorTaskEnvironment.render`."""
        return sum(self._all("render"), ()) if self.render_mode else None

    def close_extras(self, **kwargs: Any) -> None:
        """Let all go."""
        self._all("close")

    def _all(self, method: str, options: Callable[[slice], dict[str, Any]] = lambda own: {}) -> list[Any]:
        """What a method returns of each part; all begin before the first is waited for."""
        begun = [part.begin(method, **options(own)) for part, own in zip(self._parts, self._own)]
        return [wait() for wait in begun]


class _Here:
    """Environments of the process that makes them."""

    def __init__(self, make: Callable[[], gymnasium.vector.VectorEnv]):
        self._environment = make()

    def begin(self, method: str, **options: Any) -> Wait:
        """Call a method; returns what gives its result."""
        result = self.call(method, **options)
        return lambda: result

    def call(self, method: str, **options: Any) -> Any:
        """What a method returns."""
        if method == "spaces":
            return self._environment.single_observation_space, self._environment.single_action_space
        return getattr(self._environment, method)(**options)


class _Worker:
    """Environments of a worker, seen from here; it ends with this."""

    def __init__(self, ray: Any, make: Callable[[], gymnasium.vector.VectorEnv], resource: str):
        self._ray, self._hosted = ray, ray.remote(_Here).options(**{resource: 1}).remote(make)

    def begin(self, method: str, **options: Any) -> Wait:
        """Start a method there; returns what waits for its result."""
        result = self._hosted.call.remote(method, **options)

        def wait() -> Any:
            try:
                return self._ray.get(result)
            except self._ray.exceptions.RayTaskError as error:  # as it would be raised here
                raise error.cause from error
            except self._ray.exceptions.RayActorError as error:
                raise RuntimeError(f"a worker with environments ended ({' '.join(str(error).split())[:200]}); make them again") from error

        return wait


def _ray(workers: int) -> tuple[Any, str]:
    """Ray, begun, and what each worker is given one of."""
    try:
        import ray  # pyright: ignore[reportMissingImports]  (optional)
        import ray.exceptions  # pyright: ignore[reportMissingImports]  (optional)
    except ImportError as error:
        raise RuntimeError("workers need Ray, which is not installed; pip install 'endo_sim_ros[ray]'") from error
    if not ray.is_initialized():
        ray.init(include_dashboard=False, log_to_driver=False)
    resources = ray.cluster_resources()
    kind = "GPU" if resources.get("GPU") else "CPU"
    if resources.get(kind, 0) < workers:
        raise ValueError(f"{workers} workers need a {kind} each, but Ray knows of {resources.get(kind, 0):g}; give fewer workers")
    return ray, f"num_{kind.lower()}s"


def _shares(count: int, parts: int) -> list[int]:
    """A count divided as evenly as can be."""
    return [len(part) for part in np.array_split(np.arange(count), parts)]


def _within(episodes: np.ndarray, own: slice) -> np.ndarray:
    """Those of the episodes that a part has, as it numbers them."""
    episodes = np.asarray(episodes, int)
    return episodes[(own.start <= episodes) & (episodes < own.stop)] - own.start


def _joined(parts: Sequence[Any]) -> Any:
    """Results of the parts as one: arrays one after the other, tuples and dicts of them entry by entry."""
    if isinstance(parts[0], tuple):
        return tuple(map(_joined, zip(*parts)))
    if isinstance(parts[0], dict):
        return {name: _joined([part[name] for part in parts]) for name in parts[0]}
    return np.concatenate(parts)
