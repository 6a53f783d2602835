"""Scripted and learned policies, and their training."""

import importlib.util
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from played_tasks import joint_policy, linear_policy
from thorough import mostly_thorough

from endo_sim_ros.cli.train import Command
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.config import Randomisation, TrainingConfig
from endo_sim_ros.learning.dataset import learned_from
from endo_sim_ros.learning.demonstrations import _check_options
from endo_sim_ros.learning.policies import NetworkPolicy, make_policy, scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import TASKS, task_digest
from endo_sim_ros.learning.train import Best, measure_policy, play, save_training, train

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(("observations", "got"), [({"state": np.zeros((1, 40))}, "a dict"), (np.zeros(40), r"an array \[40\]")])
def test_scripts_ask_for_states_where_they_get_others(task, observations, got):
    with pytest.raises(ValueError, match=rf"takes states, an array \[B, n\], got {got}; of a dict give the part named state"):
        scripted_policy(task).act(observations)


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, count",
    [
        ("retraction", 16),
        pytest.param("palpation", 4, marks=pytest.mark.thorough),
        pytest.param("tracking", 16, marks=pytest.mark.thorough),
        pytest.param("exposure", 24, marks=pytest.mark.thorough),
        pytest.param("tension", 16, marks=pytest.mark.thorough),
        pytest.param("handover", 16, marks=pytest.mark.thorough),
        ("camera", 32),
        pytest.param("clip", 16, marks=pytest.mark.thorough),
    ],
)
def test_scripted_policies_solve_their_tasks(task, count):
    batch = TaskBatch(task, load_scene(), count, device="cpu")
    returns, success, lengths = play(batch, scripted_policy(task, count), np.arange(count))
    assert success.mean() > 0.8 and returns.mean() > 1
    if task == "retraction":
        assert play(batch, linear_policy(), np.arange(count))[1].mean() > 0.8
    few = TaskBatch(task, load_scene(), count // 4, device="cpu")  # as they all last to the end
    idle = NetworkPolicy.from_vectors(task, [], np.zeros(few.action_size * (len(few.task.observation_names) + 1)))
    assert not play(few, idle, np.arange(few.count))[1].any()


@pytest.mark.parametrize("task", mostly_thorough(["handover", "dissect", "retraction", "exposure", "tension", "clip"], 2))
def test_scripts_tell_by_and_by_that_a_jaw_is_about_to_close(task):
    """For policies that copy them: one row of a demonstration would not tell when."""
    batch, policy, numbers = TaskBatch(task, load_scene(), 1, device="cpu"), scripted_policy(task, 1), []
    batch.reset([0], [np.random.default_rng(1)])
    for _ in range(60):
        actions = policy.act(batch.state())
        numbers.append(actions.reshape(len(batch.task.arms), -1)[:, 3])
        batch.step(actions)
    for own in np.array(numbers).T:
        assert (own > 0).any()
        coming = own[: np.argmax(own > 0)]
        assert (np.diff(coming)[-2:] > 0).all() and coming[-1] > -0.5, coming


def test_a_network_is_saved_and_loaded_and_nothing_else_is(tmp_path):
    rng = np.random.default_rng(0)
    size = sum(a * b for a, b in NetworkPolicy.sizes("retraction", [5]))
    policy = NetworkPolicy.from_vectors("retraction", [5], rng.standard_normal(size))
    policy.save(tmp_path / "p.npz")
    observations = rng.standard_normal((3, 16)).astype(np.float32)
    loaded = make_policy(str(tmp_path / "p.npz"), "retraction")
    np.testing.assert_array_equal(loaded.act(observations), policy.act(observations))
    np.testing.assert_array_equal(loaded.act(observations[:1]), policy.act(observations)[:1])
    assert loaded.actions == "cartesian"
    with np.load(tmp_path / "p.npz") as file:  # as files were before there were other actions
        np.savez(tmp_path / "old.npz", **{name: file[name] for name in file.files if name != "actions"})
        np.savez(tmp_path / "feet.npz", **(dict(file) | {"actions": np.array("feet")}))
    np.testing.assert_array_equal(NetworkPolicy.load(tmp_path / "old.npz").layers[0], policy.layers[0])
    by_joints = joint_policy()
    by_joints.save(tmp_path / "joints.npz")
    assert make_policy(str(tmp_path / "joints.npz"), "retraction").actions == "joints"
    with pytest.raises(ValueError, match=r"layers of \[\(23, 7\)\] do not fit, expected \[\(17, 4\)\]"):
        NetworkPolicy("retraction", by_joints.layers)
    with pytest.raises(ValueError, match="trained for retraction, not for palpation"):
        make_policy(str(tmp_path / "p.npz"), "palpation")
    (tmp_path / "no.npz").write_text("no")
    np.savez(tmp_path / "evil.npz", task=np.array("retraction"), layer0=np.array([print], dtype=object))
    np.savez(tmp_path / "small.npz", task=np.array("retraction"), layer0=np.zeros((3, 4)))
    with np.load(tmp_path / "joints.npz") as file:
        np.savez(tmp_path / "unnamed.npz", **{name: file[name] for name in file.files if name != "actions"})
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    messages = {
        "small": "not a readable policy .*do not fit, expected [^;]*$",
        "missing": "not a readable policy .*No such file",
        "feet": "its actions are 'feet', known are cartesian, joints, joint_positions; train one",
        "unnamed": "expected .* for actions = 'cartesian'; they fit actions = 'joints' or 'joint_positions'; make",
    }
    for name, message in messages.items():
        with pytest.raises(ValueError, match=f"{name}.npz: .*{message}"):
            NetworkPolicy.load(tmp_path / f"{name}.npz")
    for name in ("no", "evil", "array"):
        with pytest.raises(ValueError, match=rf"{name}.npz is no policy file; give the policy.npz that `endo-sim train` wrote$"):
            NetworkPolicy.load(tmp_path / f"{name}.npz")


def test_a_policy_refuses_observations_that_it_was_not_made_for():
    for policy, wrong in ((joint_policy(), 16), (linear_policy(), 22)):
        expected = rf"retraction with actions = '{policy.actions}' takes observations \[B, {38 - wrong}\], got \[3, {wrong}\]"
        with pytest.raises(ValueError, match=expected):
            policy.act(np.zeros((3, wrong), np.float32))


def test_learning_that_gets_worse_keeps_what_was_best():
    best, policies = Best(), [linear_policy() for _ in range(4)]
    for policy, success, gain in zip(policies, (0.0, 0.5, 0.5, 0.25), (2.0, 1.0, 1.5, 3.0)):
        best.offer(policy, {"test_success": success, "test_return": gain})
    assert best.policy is policies[2]


@pytest.mark.thorough
@pytest.mark.slow
def test_training_learns_and_leaves_its_curve(tmp_path):
    config = TrainingConfig(generations=2, population=8, episodes=1, test_episodes=3)
    policy, curve = train("retraction", load_scene(), config, device="cpu")
    again, _ = train("retraction", load_scene(), config, device="cpu")
    np.testing.assert_array_equal(policy.layers[0], again.layers[0])
    assert [point["episodes"] for point in curve] == [0, 8, 16]
    assert curve[-1]["test_return"] > curve[0]["test_return"]
    found = measure_policy(TaskBatch("retraction", load_scene(), 3, device="cpu"), policy)
    assert found["test_return"] == max((point["test_success"], point["test_return"]) for point in curve)[1]
    save_training(tmp_path, policy, curve, config)
    assert json.loads((tmp_path / "curve.json").read_text())["curve"] == curve
    by_joints, _ = train(
        "retraction", load_scene(), replace(config, generations=1, population=4, test_episodes=1), device="cpu", actions="joints"
    )
    assert by_joints.actions == "joints" and by_joints.layers[0].shape == (23, 7)
    assert (tmp_path / "curve.png").stat().st_size > 1000 and NetworkPolicy.load(tmp_path / "policy.npz").task == "retraction"


@pytest.mark.thorough
@pytest.mark.dds
def test_the_code_in_the_guide_runs(tmp_path):
    guide = (ROOT / "docs" / "learning.md").read_text()
    blocks = [block for block in re.findall(r"```python\n(.+?)```", guide, re.S) if "rclpy.spin" not in block]  # see test_node_policy.py
    if importlib.util.find_spec("stable_baselines3") is None:
        blocks = [block for block in blocks if "stable_baselines3" not in block]
    code = "\n".join(blocks)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "solved: 1.0" in done.stdout


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_the_scripts_solve_as_on_a_cpu_and_images_are_alike():
    for task, count in (("retraction", 256), ("palpation", 64), ("tracking", 256), ("tension", 256), ("handover", 256), ("clip", 256)):
        batch = TaskBatch(task, load_scene(), count, randomisation=Randomisation(stiffness=0.1), images=True, device="cuda")
        _, success, _ = play(batch, scripted_policy(task, count), np.arange(count))
        assert success.mean() > 0.9, task
    gpu, cpu = (TaskBatch("retraction", load_scene(), 2, "image", device=device) for device in ("cuda", "cpu"))
    for batch in (gpu, cpu):
        batch.reset([0, 1], [np.random.default_rng(s) for s in (0, 1)])
    assert np.abs(gpu.observe().astype(int) - cpu.observe()).mean() < 0.5


def test_a_training_that_is_interrupted_keeps_its_best_or_says_that_there_is_none(tmp_path, monkeypatch, capsys, caplog):
    from endo_sim_ros.learning import train as training

    measured = training.measure_policy

    def interrupted(batch, policy):
        interrupted.count += 1
        if interrupted.count == 3:
            raise KeyboardInterrupt
        return measured(batch, policy)

    interrupted.count = 0
    monkeypatch.setattr(training, "measure_policy", interrupted)
    config = TrainingConfig(generations=4, population=4, test_episodes=2)
    with pytest.raises(KeyboardInterrupt):
        Command(tmp_path / "out", config=config, device="cpu").run()
    assert len(json.loads((tmp_path / "out/curve.json").read_text())["curve"]) == 2
    assert make_policy(str(tmp_path / "out/policy.npz"), "retraction").actions == "cartesian"
    assert "of test episodes solved after" in capsys.readouterr().out and not caplog.text
    interrupted.count = 1
    with pytest.raises(KeyboardInterrupt):
        Command(tmp_path / "soon", config=config, device="cpu").run()
    assert "soon/policy.npz is not there, and nothing is kept: no policy was tested since it began to learn" in caplog.text
    assert not (tmp_path / "soon").exists()


def test_a_task_of_ones_own_is_the_same_from_every_folder_unless_its_file_is_another(tmp_path, monkeypatch, caplog):
    (tmp_path / "stroke.py").write_text(
        "from endo_sim_ros.learning.tasks.retraction import Retraction\n\n\nclass Stroke(Retraction):\n    name = 'stroke'\n"
    )
    monkeypatch.chdir(tmp_path)
    policy = NetworkPolicy("stroke.py:Stroke", linear_policy().layers)
    policy.save("policy.npz")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for name in (f"{tmp_path}/stroke.py:Stroke", "../stroke.py:Stroke"):
        assert make_policy("../policy.npz", name).task == name
    with pytest.raises(ValueError, match="was trained for|not a readable policy"):
        make_policy("../policy.npz", "tracking")
    assert not caplog.text and not task_digest("endo_sim_ros.learning.tasks.tension:FixedTension")
    (tmp_path / "elsewhere/stroke.py").write_text((tmp_path / "stroke.py").read_text() + "    hold = 7\n")
    other = f"{tmp_path}/elsewhere/stroke.py:Stroke"
    make_policy("../policy.npz", other)
    assert "../policy.npz was made for another stroke.py:Stroke: the file was changed since, or is another of this name" in caplog.text
    (tmp_path / "dataset/meta").mkdir(parents=True)
    for options in ({"task": "stroke.py:Stroke"}, {"task": "stroke.py:Stroke", "task_digest": task_digest("../stroke.py:Stroke")}):
        (tmp_path / "dataset/meta/demonstrations.json").write_text(json.dumps(options))
        _check_options(tmp_path / "dataset", {"task": "../stroke.py:Stroke", "task_digest": task_digest("../stroke.py:Stroke")})
    assert learned_from(tmp_path / "dataset")["digest"] == policy.digest != task_digest(other)
    with pytest.raises(SequenceError, match="dataset was begun with another stroke.py:Stroke: the file was changed since"):
        _check_options(tmp_path / "dataset", {"task": other, "task_digest": task_digest(other)})
    with pytest.raises(SequenceError, match="was begun with task 'stroke.py:Stroke';"):
        _check_options(tmp_path / "dataset", {"task": "../stroke.py:Other", "task_digest": "a"})
