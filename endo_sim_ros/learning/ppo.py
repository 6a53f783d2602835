"""Proximal policy optimisation by stable-baselines3, on many episodes at once: `endo-sim train --algorithm ppo`."""

import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from rich.progress import Progress, track

from endo_sim_ros.core.device import single_threaded_torch
from endo_sim_ros.learning.actions import Actions, Contact
from endo_sim_ros.learning.config import PPOConfig, Randomisation
from endo_sim_ros.learning.environments import Observed, VectorTaskEnvironment
from endo_sim_ros.learning.joined import JoinedEnvironments
from endo_sim_ros.learning.policies import NetworkPolicy
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.train import Best, measure_policy
from endo_sim_ros.physics import MotionConfig

try:
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]  (optional)
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]  (optional)
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]  (optional)
    from stable_baselines3.common.vec_env.base_vec_env import (  # pyright: ignore[reportMissingImports]  (optional)
        VecEnvIndices,
        VecEnvObs,
        VecEnvStepReturn,
    )
except ImportError as error:
    raise ImportError("PPO needs stable-baselines3, which is not installed; pip install 'endo_sim_ros[rl]'") from error


_FITTED, _ROWS, _RATE = 6000, 512, 2e-3  # steps, rows of each, and greatest rate with which a policy is fitted to a script
_VALUED = 0.05  # how much the square error of values, which are up to about 10, counts beside that of actions


class StableEnvironments(VecEnv):
    """Many environments as stable-baselines3 takes them: an ended episode begins anew within the step that ended it.

    Args:
        environment: The environments.
    """

    def __init__(self, environment: VectorTaskEnvironment | JoinedEnvironments):
        self.environment = environment
        super().__init__(environment.num_envs, environment.single_observation_space, environment.single_action_space)

    def reset(self) -> VecEnvObs:
        """First observations [B, n] of all environments, by the seeds that were set."""
        observations, _ = self.environment.reset(seed=list(self._seeds))
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Keep actions [B, 4 or 7] for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Observations [B, n], rewards [B], ends [B] and infos after the step with the kept actions."""
        observations, rewards, terminated, truncated, info = self.environment.step(self._actions)
        ended = np.flatnonzero(terminated | truncated)
        infos = [{name: values[i] for name, values in info.items()} for i in range(self.num_envs)]
        for i in ended.tolist():
            infos[i]["terminal_observation"] = _of(observations, i)
            infos[i]["TimeLimit.truncated"] = bool(truncated[i])
        if len(ended):
            observations = self.environment.renew(ended)
        return observations, rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        """Close the environments."""
        self.environment.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Images [H, W, 3], uint8, of all environments."""
        return self.environment.render() or ()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the environments, once for each index."""
        return [getattr(self.environment, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all environments.

        Raises:
            ValueError: If the indices are not those of all environments.
        """
        self._all(indices)
        setattr(self.environment, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any) -> list[Any]:
        """Results of a method of all environments.

        Raises:
            ValueError: If the indices are not those of all environments.
        """
        self._all(indices)
        return [getattr(self.environment, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def _all(self, indices: VecEnvIndices) -> None:
        if sorted(self._get_indices(indices)) != list(range(self.num_envs)):
            raise ValueError(f"the {self.num_envs} environments are one object; set or call all of them, without indices")

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """False for each index: there are no wrappers."""
        return [False] * len(list(self._get_indices(indices)))


def _of(observations: Observed, i: int) -> Observed:
    """A copy of environment i's observation."""
    if isinstance(observations, dict):
        return {name: values[i].copy() for name, values in observations.items()}
    return observations[i].copy()


def network(task: str, model: PPO, actions: Actions = "cartesian") -> NetworkPolicy:
    """The mean action of a PPO model with tanh layers and state observations, as a policy that needs no torch."""
    linear = [layer for layer in model.policy.mlp_extractor.policy_net if isinstance(layer, torch.nn.Linear)]
    layers = [torch.cat([layer.weight.T, layer.bias[None]]) for layer in (*linear, model.policy.action_net)]
    return NetworkPolicy(task, [layer.detach().cpu().numpy() for layer in layers], actions)


def learn_script(model: PPO, batch: TaskBatch, config: PPOConfig) -> None:
    """Let a model act as the script of a task does, and value states by what follows there, so that PPO begins with both.

    The script acts with the noise with which the model is to explore, so that it shows the way back (as DAgger does for a learner's own
    errors; that demonstrations begin and reward goes on is Rajeswaran et al. 2018, https://arxiv.org/abs/1709.10087).

    Args:
        model: Of PPO, with the observations and actions of the batch.
        batch: Where the script acts, in as many rounds as it takes.
        config: How many episodes, and the noise.

    Raises:
        ValueError: If the actions are those of joints: scripts move tips.
    """
    if batch.actions != "cartesian":
        raise ValueError(f"scripts move tips, but actions are {batch.actions}; leave out --ppo.demonstrations, or take cartesian actions")
    rng, rounds = np.random.default_rng([config.seed, 0xDE]), -(-config.demonstrations // batch.count)
    parts = [_shown(batch, config, rng) for _ in track(range(rounds), "demonstrations", transient=True)]
    seen, done, worth = (torch.from_numpy(np.concatenate(part).astype(np.float32)) for part in zip(*parts))
    optimizer = torch.optim.Adam(model.policy.parameters(), _RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, _FITTED)
    generator = torch.Generator().manual_seed(config.seed)
    for _ in track(range(_FITTED), "learning from them", transient=True):
        rows = torch.randint(len(seen), (_ROWS,), generator=generator)
        acted, valued = model.policy.get_distribution(seen[rows]).distribution.mean, model.policy.predict_values(seen[rows])[:, 0]
        loss = (acted - done[rows]).square().mean() + _VALUED * (valued - worth[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


def _shown(batch: TaskBatch, config: PPOConfig, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a script observes [T, n] in an episode of each environment, does without its noise [T, m], and gets from then on [T]."""
    everyone, policy = range(batch.count), batch.task.script(batch.count)
    batch.reset(everyone, rng.spawn(batch.count))
    policy.reset(everyone)
    seen, running, rows = batch.observe(), np.ones(batch.count, bool), []
    while running.any():
        assert isinstance(seen, np.ndarray)  # states
        actions = np.clip(policy.act(seen), -1, 1)
        after, outcome = batch.step(np.clip(actions + config.spread * rng.standard_normal(actions.shape), -1, 1))
        rows.append((seen, actions, outcome.reward * running, running.copy()))
        seen, running = after, running & ~(outcome.terminated | outcome.truncated)
    observations, done, rewards, running = (np.array(values) for values in zip(*rows))
    for step in reversed(range(len(rewards) - 1)):
        rewards[step] += config.gamma * rewards[step + 1]
    return observations[running], done[running], rewards[running]


class _Curve(BaseCallback):
    """Tests the policy now and then while it learns."""

    def __init__(self, task: str, testing: TaskBatch, config: PPOConfig, bar: Progress, best: Best):
        super().__init__()
        self._task, self._testing, self._config, self._bar = task, testing, config, bar
        self._progress = bar.add_task("training", total=config.steps)
        self._episodes, self._began = 0, time.monotonic()
        self._best = best

    def _on_step(self) -> bool:
        self._episodes += int(self.locals["dones"].sum())
        self._bar.update(self._progress, completed=self.num_timesteps)
        return True

    def _on_rollout_start(self) -> None:  # the policy has just been improved
        if self.num_timesteps >= len(self._best.curve) * self._config.steps / self._config.tests:
            self.test()

    def test(self) -> None:
        policy = network(self._task, self.model, self._testing.actions)
        tested = measure_policy(self._testing, policy)
        self._best.offer(policy, tested)
        seconds = time.monotonic() - self._began
        self._best.curve.append({"episodes": self._episodes, "steps": self.num_timesteps, **tested, "seconds": seconds})
        self._bar.update(self._progress, description=f"solved {tested['test_success']:.0%}")


@single_threaded_torch()
def train_ppo(
    task: str,
    scene: Scene,
    config: PPOConfig,
    randomisation: Randomisation = Randomisation(),
    device: str = "auto",
    actions: Actions = "cartesian",
    contact: Contact = "point",
    motion: MotionConfig = MotionConfig(),
    best: Best | None = None,
) -> tuple[NetworkPolicy, list[dict[str, float]]]:
    """Train a policy by PPO on states; repeatable bit by bit on a CPU. With ``best`` it is put there as it learns, as by `train`.

    Returns:
        The best policy, see `Best`, and the learning curve: number of training episodes and steps so far, test return and success
        rate, and seconds; first of the policy before it learns by reward.

    Raises:
        ValueError: If demonstrations are wanted and actions are those of joints.
    """
    options: dict[str, Any] = {
        "scene": scene,
        "randomisation": randomisation,
        "device": device,
        "actions": actions,
        "contact": contact,
        "motion": motion,
    }
    environments = VectorTaskEnvironment(task, config.environments, **options)
    testing = TaskBatch(task, count=config.test_episodes, **options)
    rollout = config.environments * config.rollout
    model = PPO(
        "MlpPolicy",
        StableEnvironments(environments),
        seed=config.seed,
        n_steps=config.rollout,
        batch_size=max(rollout // config.minibatches, 2),
        learning_rate=config.learning_rate,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        policy_kwargs={"net_arch": [config.hidden] * 2, "log_std_init": np.log(config.spread)},
        device="cpu",  # so small a network is faster there
    )
    if config.demonstrations:
        learn_script(model, environments.batch, config)
    best = Best() if best is None else best
    with Progress() as bar:
        callback = _Curve(task, testing, config, bar, best)
        model.learn(config.steps, callback=callback)
        callback.test()
    return best.policy, best.curve
