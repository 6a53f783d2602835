"""Environments and policies of Stable Baselines3."""

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from played_tasks import make, play

from endo_sim_ros.cli.train import Command
from endo_sim_ros.learning import environments
from endo_sim_ros.learning.config import PPOConfig
from endo_sim_ros.learning.policies import make_policy, scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.train import measure_policy, save_training

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("task, observations", [("retraction", "state"), ("palpation", "both")])
def test_stable_baselines3_finds_nothing_to_complain_about(task, observations):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(make(task, observations=observations, render_mode="rgb_array").unwrapped)


def test_environments_of_stable_baselines3_begin_anew_at_once():
    ppo = pytest.importorskip("endo_sim_ros.learning.ppo", exc_type=ImportError)
    many = environments.VectorTaskEnvironment("retraction", 2, device="cpu")
    stable, policy = ppo.StableEnvironments(many), scripted_policy("retraction")
    stable.seed(0)
    observations, dones = stable.reset(), np.zeros(2, bool)
    while not dones.any():
        actions = policy.act(observations)
        actions[1] = 0, 0, 0, -1
        before = observations
        observations, rewards, dones, infos = stable.step(actions)
    assert dones.tolist() == [True, False] and infos[0]["success"] and rewards[0] > 1
    names = many.batch.task.observation_names
    at_end, begun = (dict(zip(names, row)) for row in (infos[0]["terminal_observation"], observations[0]))
    assert at_end["spot_moved_z"] >= 1 and begun["spot_moved_z"] == 0 and begun["time_left"] == 1 and begun["force"] == 0
    assert "terminal_observation" not in infos[1] and observations[1][-1] < before[1][-1]
    stable.set_attr("label", "tissue")
    assert many.label == "tissue" and stable.get_attr("label") == ["tissue"] * 2
    assert stable.env_method("render") == [many.render()] * 2
    with pytest.raises(ValueError, match="the 2 environments are one object"):
        stable.env_method("render", indices=[1])
    seen, *_ = play(make(), scripted_policy("retraction"), 0)
    np.testing.assert_array_equal(infos[0]["terminal_observation"], seen[-1])  # the episode of gymnasium with that seed
    for _ in range(60):
        _, _, dones, infos = stable.step(np.tile([0, 0, 0, -1.0], (2, 1)))
        if dones[1]:
            break
    assert infos[1]["TimeLimit.truncated"] and not infos[1]["success"]


def test_ppo_trains_a_policy_that_needs_no_torch(tmp_path):
    ppo = pytest.importorskip("endo_sim_ros.learning.ppo", exc_type=ImportError)
    config = PPOConfig(steps=1200, environments=6, rollout=100, hidden=8, tests=1, test_episodes=4)
    (policy, curve), (again, _) = (ppo.train_ppo("retraction", load_scene(), config, device="cpu") for _ in range(2))
    for layer, same in zip(policy.layers, again.layers):
        np.testing.assert_array_equal(layer, same)
    assert [point["steps"] for point in curve] == [0, 1200] and curve[-1]["episodes"] > 0
    assert curve[-1]["test_return"] > curve[0]["test_return"]
    save_training(tmp_path, policy, curve, config)
    assert make_policy(str(tmp_path / "policy.npz"), "retraction").layers[0].shape == (17, 8)
    stable = ppo.StableEnvironments(environments.VectorTaskEnvironment("retraction", 2, device="cpu"))
    model = ppo.PPO("MlpPolicy", stable, n_steps=2, batch_size=2, device="cpu")  # with stable-baselines3's own network
    observations = stable.reset()
    actions = np.clip(ppo.network("retraction", model).act(observations), -1, 1)
    np.testing.assert_allclose(actions, model.predict(observations, deterministic=True)[0], atol=1e-6)


def test_a_policy_that_begins_from_its_script_solves_what_chance_does_not(monkeypatch):
    ppo = pytest.importorskip("endo_sim_ros.learning.ppo", exc_type=ImportError)
    monkeypatch.setattr(ppo, "_FITTED", 800)
    config = PPOConfig(environments=8, spread=0.2, demonstrations=10)
    many = environments.VectorTaskEnvironment("retraction", 8, device="cpu")
    models = [ppo.PPO("MlpPolicy", ppo.StableEnvironments(many), n_steps=2, batch_size=2, seed=0, device="cpu") for _ in range(2)]
    before = measure_policy(many.batch, ppo.network("retraction", models[0]))
    for model in models:
        ppo.learn_script(model, many.batch, config)
    after = measure_policy(many.batch, ppo.network("retraction", models[0]))
    assert before["test_success"] == 0 and after["test_success"] >= 0.75
    for first, second in zip(*(model.policy.parameters() for model in models)):
        np.testing.assert_array_equal(first.detach(), second.detach())
    many.reset(seed=0)
    worth = models[0].policy.predict_values(torch.from_numpy(many.batch.observe())).mean()
    scripted = measure_policy(many.batch, scripted_policy("retraction", 8))["test_return"]
    assert 0.5 * scripted < float(worth) < scripted  # by the discount


def test_a_task_of_ones_own_shows_its_script(monkeypatch, tmp_path):
    ppo = pytest.importorskip("endo_sim_ros.learning.ppo", exc_type=ImportError)
    monkeypatch.setattr(ppo, "_FITTED", 10)
    lines = "from endo_sim_ros.learning.tasks.tracking import Tracking", "class Own(Tracking):", "    name = 'own'"
    (tmp_path / "own.py").write_text("\n".join(lines))
    config = PPOConfig(steps=4, environments=2, rollout=2, tests=1, test_episodes=1, demonstrations=1)
    assert ppo.train_ppo(f"{tmp_path / 'own.py'}:Own", load_scene(), config, device="cpu")[1]


def test_what_a_script_has_taught_is_kept_by_an_interrupt_before_the_first_reward(monkeypatch, tmp_path):
    ppo = pytest.importorskip("endo_sim_ros.learning.ppo", exc_type=ImportError)
    monkeypatch.setattr(ppo, "_FITTED", 10)
    monkeypatch.setattr(ppo.StableEnvironments, "step_wait", lambda _: sys.exit(143))
    config = PPOConfig(steps=8, environments=2, rollout=2, test_episodes=1, demonstrations=1)
    with pytest.raises(SystemExit):
        Command(tmp_path / "taught", algorithm="ppo", ppo=config, device="cpu").run()
    assert make_policy(str(tmp_path / "taught/policy.npz"), "retraction").layers


def test_scripts_do_not_show_how_joints_move():
    ppo = pytest.importorskip("endo_sim_ros.learning.ppo", exc_type=ImportError)
    config = PPOConfig(steps=4, environments=2, rollout=2, test_episodes=1, demonstrations=1)
    with pytest.raises(ValueError, match="scripts move tips, but actions are joints; leave out --ppo.demonstrations"):
        ppo.train_ppo("retraction", load_scene(), config, device="cpu", actions="joints")


@pytest.mark.thorough
@pytest.mark.dds
def test_without_stable_baselines3_one_sentence_says_what_to_install(tmp_path):
    code = "import sys; sys.modules['stable_baselines3'] = None; from endo_sim_ros.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "train", tmp_path / "out", "--algorithm", "ppo"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    sentence = "endo-sim: PPO needs stable-baselines3, which is not installed; pip install 'endo_sim_ros[rl]'"
    assert done.returncode == 1 and done.stderr.strip() == sentence
