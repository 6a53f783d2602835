"""Tasks to learn: as Gymnasium environments, many at once, over topics; scripted and learned policies."""

import importlib.util
import json
import os
import re
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import rclpy
import torch
from conftest import wait_until
from gymnasium.utils.env_checker import check_env
from test_nodes import Bench

from benchmarks.environments import bench_environments
from endo_sim_ros import messages
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.light import Light
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.learning import environments
from endo_sim_ros.learning.config import PPOConfig, Randomisation, TrainingConfig
from endo_sim_ros.learning.policies import NetworkPolicy, make_policy, scripted_policy
from endo_sim_ros.learning.scenes import Scene, load_scene, save_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import TASKS
from endo_sim_ros.learning.train import run_episodes, save_training, train
from endo_sim_ros.physics import TissueSimulation

ROOT = Path(__file__).parents[1]
IDS = {name: f"endo_sim_ros/{name.capitalize()}-v0" for name in TASKS}
VARIED = {"stiffness": 0.4, "light": 0.5, "texture": 0.5, "camera_position": 0.005, "camera_angle": 5.0}


def make(task="retraction", **options):
    return gymnasium.make(IDS[task], device="cpu", **options)


def play(environment, policy, seed, steps=200):
    """Observations, and rewards, of one episode."""
    observation, info = environment.reset(seed=seed)
    policy.reset([0])
    seen, rewards = [observation], []
    for _ in range(steps):
        state = observation["state"] if isinstance(observation, dict) else observation
        observation, reward, terminated, truncated, info = environment.step(policy.act(state[None])[0])
        seen.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            break
    return seen, rewards, info


@pytest.mark.parametrize("observations", ["state", "image", "both"])
@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_nothing_to_complain_about(task, observations):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(task, observations=observations, render_mode="rgb_array", randomisation=VARIED).unwrapped)


def test_observations_have_names_and_units():
    environment = make()
    names = environment.unwrapped.batch.task.observation_names
    assert environment.observation_space.shape == (len(names),) and len(set(names)) == len(names)
    observation, _ = environment.reset(seed=1)
    o = dict(zip(names, observation))
    np.testing.assert_allclose(o["distance"], np.linalg.norm([o[f"spot_from_tip_{axis}"] for axis in "xyz"]), rtol=1e-5)
    assert o["time_left"] == 1 and o["jaw"] == -1 and o["force"] == 0
    tip = 0.02 * np.array([o[f"tip_{axis}"] for axis in "xyz"])
    after = dict(zip(names, environment.step(np.array([1, -0.5, -1, -1], np.float32))[0]))
    expected = np.clip(tip + [0.002, -0.001, -0.002], environment.unwrapped.batch.task.low, environment.unwrapped.batch.task.high)
    np.testing.assert_allclose([0.02 * after[f"tip_{axis}"] for axis in "xyz"], expected, atol=1e-7)


def test_the_same_seed_and_actions_give_the_same_bytes_whatever_the_threads():
    code = f"""
import hashlib, sys
sys.path.insert(0, {str(ROOT / "test")!r})
from test_environments import TASKS, VARIED, make, play
from endo_sim_ros.learning.policies import scripted_policy
for task in TASKS:
    seen, rewards, _ = play(make(task, observations="both", randomisation=VARIED), scripted_policy(task), 3, 40)
    print(hashlib.sha256(b"".join(o[k].tobytes() for o in seen for k in o) + repr(rewards).encode()).hexdigest())
"""
    runs = []
    for threads in ("1", "2"):
        variables = os.environ | {"ENDO_SIM_THREADS": threads}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=variables, cwd=ROOT)
        assert done.returncode == 0, done.stderr
        runs.append(done.stdout)
    assert runs[0] == runs[1] and len(set(runs[0].split())) == len(TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_each_of_many_environments_is_the_single_one_with_its_seed(task):
    count, seed, steps = 3, 20, 60
    options = {"observations": "both", "randomisation": VARIED, "device": "cpu"}
    many = gymnasium.make_vec(IDS[task], num_envs=count, vectorization_mode="vector_entry_point", **options)
    policy = scripted_policy(task, count)
    observations, _ = many.reset(seed=seed)
    recorded = []
    for _ in range(steps):
        observations, rewards, terminated, truncated, _ = many.step(policy.act(observations["state"]))
        recorded.append((observations, rewards, terminated | truncated))
        if (terminated | truncated).any():
            break
    assert len(recorded) > 10
    single = make(task, observations="both", randomisation=VARIED)
    seen, rewards, _ = play(single, scripted_policy(task), seed + 1, len(recorded))
    for k, reward in enumerate(rewards):
        for kind in ("state", "image"):
            np.testing.assert_array_equal(recorded[k][0][kind][1], seen[k + 1][kind])
        assert recorded[k][1][1] == reward


def test_many_environments_begin_anew_one_by_one_and_count_their_seeds():
    many = gymnasium.make_vec(IDS["retraction"], num_envs=2, vectorization_mode="vector_entry_point", device="cpu")
    first, _ = many.reset(seed=np.array([5, 8]))
    np.testing.assert_array_equal(first[1], many.reset(seed=7)[0][1])
    moved = many.step(np.ones((2, 4)))[0]
    again, _ = many.reset(seed=[3, 5], options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(again[0], moved[0])
    np.testing.assert_array_equal(again[1], first[0])
    with pytest.raises(ValueError, match="2 environments need as many seeds, got 1"):
        many.reset(seed=[1])
    with pytest.raises(ValueError, match="as many places in reset_mask, got 3"):
        many.reset(options={"reset_mask": np.ones(3, bool)})


def test_ended_environments_begin_anew_at_the_next_step_and_others_go_on():
    many = gymnasium.make_vec(IDS["retraction"], num_envs=2, vectorization_mode="vector_entry_point", device="cpu")
    policy = scripted_policy("retraction")
    observations, _ = many.reset(seed=0)
    idle = np.array([0, 0, 0, -1.0])
    for _ in range(60):
        actions = policy.act(observations)
        actions[1] = idle
        observations, _, terminated, truncated, info = many.step(actions)
        if terminated[0]:
            break
    assert terminated.tolist() == [True, False] and info["success"].tolist() == [True, False]
    before = observations[1]
    observations, rewards, terminated, truncated, _ = many.step(np.tile(idle, (2, 1)))
    assert rewards[0] == 0 and not (terminated | truncated).any()
    o = dict(zip(many.unwrapped.batch.task.observation_names, observations.T))
    assert o["time_left"][0] == 1 and o["force"][0] == 0 and o["spot_moved_z"][0] == 0
    assert o["time_left"][1] < before[-1]


@pytest.mark.parametrize("task, count", [("retraction", 48), ("palpation", 8)])
def test_scripted_policies_solve_their_tasks(task, count):
    batch = TaskBatch(task, load_scene(), count, device="cpu")
    returns, success, lengths = run_episodes(batch, scripted_policy(task, count), np.arange(count))
    assert success.mean() > 0.8 and returns.mean() > 1
    if task == "retraction":
        assert run_episodes(batch, linear_policy(), np.arange(count))[1].mean() > 0.8
    idle = NetworkPolicy.from_vectors(task, [], np.zeros(4 * (len(batch.task.observation_names) + 1)))
    assert not run_episodes(batch, idle, np.arange(count))[1].any()


def test_pulling_too_hard_ends_the_episode(monkeypatch):
    monkeypatch.setattr(TASKS["retraction"], "force_limit", 0.3)
    environment = make()
    _, rewards, info = play(environment, scripted_policy("retraction"), 0, 60)
    assert len(rewards) < 60 and not info["success"] and info["force"] > 0.3 and rewards[-1] < 0


def test_an_inclusion_is_the_region_that_physics_node_would_paint():
    """A factor on each node's moduli gives the bits of painted properties: pins, contact and all."""
    batch = TaskBatch("palpation", load_scene(), 2, device="cpu")
    batch.reset([0, 1], [np.random.default_rng(s) for s in (5, 6)])
    regions = batch.task.regions()
    painted = TissueSimulation.from_nodes(batch.task.nodes, replace(batch.task.physics("cpu"), regions=regions))
    policy, observations = scripted_policy("palpation", 2), batch.observe()
    for _ in range(25):
        observations, _ = batch.step(policy.act(observations))
        pose = np.eye(4)
        pose[:3, 3] = batch.tissue.tools.tips[0, 0].numpy()
        painted.set_grasp("PSM1", pose, False)
        painted.step()
        np.testing.assert_array_equal(batch.tissue.displacements[0].numpy(), painted.solver.displacements())
    assert np.abs(painted.solver.displacements()).max() > 1e-4
    assert not np.array_equal(batch.task.stiffness(0), batch.task.stiffness(1))


def test_stiffness_beyond_what_the_substeps_were_planned_for_is_refused():
    solver = TaskBatch("palpation", load_scene(), 1, device="cpu").tissue.solver
    with pytest.raises(ValueError, match="not above 8"):
        solver.set_stiffness(slice(None), np.full((1, solver.node_count), 9.0))


def test_randomisation_changes_what_it_names_and_nothing_else():
    scene = load_scene()

    def first(**kinds):
        batch = TaskBatch("retraction", scene, 1, "both", Randomisation(**kinds), device="cpu")
        batch.reset([0], [np.random.default_rng(3)])
        return batch, batch.observe()

    plain, observed = first()
    for kinds in ({"light": 0.5}, {"texture": 0.8}, {"camera_position": 0.01}, {"camera_angle": 10.0}):
        _, other = first(**kinds)
        assert np.abs(other["image"].astype(int) - observed["image"]).mean() > 1, kinds
        np.testing.assert_array_equal(other["state"], observed["state"])
    soft, other = first(stiffness=1.0)
    np.testing.assert_array_equal(other["image"], observed["image"])
    factors = soft.tissue.solver._scale.numpy()
    assert np.ptp(factors) == 0 and factors[0] != 1 and np.exp(-1) <= factors[0] <= np.e
    with pytest.raises(ConfigError, match="Randomisation has no option stifness; it has stiffness, "):
        make("retraction", randomisation={"stifness": 0.1})
    with pytest.raises(ConfigError, match=r"Randomisation.light must lie in \[0, 0.9\]"):
        make(randomisation={"light": 2.0})


@pytest.mark.parametrize("light, degree", [(None, 0), (None, 1), (Light(distance=0.9, angle=0.4, response=0.3), 0)])
def test_images_are_those_of_the_renderer(light, degree):
    from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig

    scene = load_scene()
    sh = torch.cat([scene.model.sh, torch.randn(len(scene.model), 3, 3, generator=torch.Generator().manual_seed(0))], 1)
    scene = replace(scene, model=replace(scene.model, light=light, sh=sh[:, : (degree + 1) ** 2]))
    environment = make(observations="image", scene=scene)
    batch = environment.unwrapped.batch
    script = scripted_policy("retraction")
    image, _ = environment.reset(seed=0)
    for _ in range(16):
        image, *_ = environment.step(script.act(batch._state())[0])
    renderer = DeformableRenderer(scene.model, batch.task.nodes.rest, RenderingConfig(device="cpu"))
    pinned = torch.from_numpy(batch.task.nodes.pinned)[:, None, None]
    F = torch.where(pinned, torch.eye(3), batch.tissue.F[0])  # as on control_nodes
    expected, _ = renderer.render(batch.camera, batch.tissue.positions()[0], F)
    assert batch.tissue.displacements.abs().max() > 1e-3
    np.testing.assert_array_equal(image, expected)


def test_a_task_is_seen_by_the_view_in_the_middle_as_in_the_graph():
    scene = load_scene()
    poses = [np.eye(4), scene.camera.pose, np.eye(4)]
    poses[0][0, 3], poses[2][1, 3] = 0.01, 0.02
    assert np.array_equal(Scene(scene.model, tuple(scene.camera.at(pose) for pose in poses)).camera.pose, poses[1])


def test_a_network_is_saved_and_loaded_and_nothing_else_is(tmp_path):
    rng = np.random.default_rng(0)
    size = sum(a * b for a, b in NetworkPolicy.sizes("retraction", [5]))
    policy = NetworkPolicy.from_vectors("retraction", [5], rng.standard_normal(size))
    policy.save(tmp_path / "p.npz")
    observations = rng.standard_normal((3, 16)).astype(np.float32)
    loaded = make_policy(str(tmp_path / "p.npz"), "retraction")
    np.testing.assert_array_equal(loaded.act(observations), policy.act(observations))
    np.testing.assert_array_equal(loaded.act(observations[:1]), policy.act(observations)[:1])
    with pytest.raises(ValueError, match="trained for retraction, not for palpation"):
        make_policy(str(tmp_path / "p.npz"), "palpation")
    (tmp_path / "no.npz").write_text("no")
    np.savez(tmp_path / "evil.npz", task=np.array("retraction"), layer0=np.array([print], dtype=object))
    np.savez(tmp_path / "small.npz", task=np.array("retraction"), layer0=np.zeros((3, 4)))
    for name in ("no", "evil", "small", "missing"):
        with pytest.raises(ValueError, match=f"{name}.npz: not a readable policy"):
            NetworkPolicy.load(tmp_path / f"{name}.npz")


def test_training_learns_and_leaves_its_curve(tmp_path):
    config = TrainingConfig(generations=2, population=24, episodes=1, test_episodes=8)
    policy, curve = train("retraction", load_scene(), config, device="cpu")
    again, _ = train("retraction", load_scene(), config, device="cpu")
    np.testing.assert_array_equal(policy.layers[0], again.layers[0])
    assert [point["episodes"] for point in curve] == [0, 24, 48]
    assert curve[-1]["test_return"] > curve[0]["test_return"]
    save_training(tmp_path, policy, curve, config)
    assert json.loads((tmp_path / "curve.json").read_text())["curve"] == curve
    assert (tmp_path / "curve.png").stat().st_size > 1000 and NetworkPolicy.load(tmp_path / "policy.npz").task == "retraction"


def test_what_was_felt_most_is_remembered():
    batch = TaskBatch("palpation", load_scene(), 2, device="cpu")
    batch.reset([0, 1], [np.random.default_rng(s) for s in (5, 6)])
    policy, observations = scripted_policy("palpation", 2), batch.observe()
    rows, tips = [], []
    for _ in range(60):
        observations, _ = batch.step(policy.act(observations))
        rows.append(dict(zip(batch.task.observation_names, observations[0].astype(np.float64))))
        tips.append(0.02 * np.array([rows[-1]["tip_x"], rows[-1]["tip_y"]]))
    forces = [row["force"] for row in rows]
    assert max(forces) > 0.3 and forces[-1] < max(forces)
    np.testing.assert_allclose(rows[-1]["most"], max(forces))
    where = tips[-1] + 0.02 * np.array([rows[-1]["most_from_tip_x"], rows[-1]["most_from_tip_y"]])
    np.testing.assert_allclose(where, tips[int(np.argmax(forces))], atol=1e-8)


def test_a_report_is_ten_steps_that_say_so():
    environment = make("palpation")
    environment.reset(seed=0)
    ended = [environment.step(np.array([0, 0, 0, sign]))[2] for sign in [1] * 9 + [-1] + [1] * 10]
    assert ended == [False] * 19 + [True]


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


def linear_policy():
    """Weights by hand that solve retraction: towards the spot, closed when near, up until it is raised."""
    names = TASKS["retraction"].observation_names
    weights = np.zeros((len(names) + 1, 4))
    for axis, name in enumerate("xyz"):
        weights[names.index(f"spot_from_tip_{name}"), axis] = 10
    weights[names.index("jaw"), 2] = weights[-1, 2] = 1.5
    weights[names.index("spot_moved_z"), 2] = -2.3
    weights[names.index("distance"), 3], weights[-1, 3] = -10, 2
    return NetworkPolicy("retraction", [weights])


def assert_same_as_environment(record, task, policy, seed, episodes):
    """The steps in a file are, bit for bit, those of the environment; returns its images of the last episode, the first at rest."""
    heard, environment, k = np.load(record), make(task, render_mode="rgb_array"), 0
    for episode in range(episodes):
        observation, _ = environment.reset(seed=seed + episode)
        images = [environment.render()]
        policy.reset([0])
        ended = False
        while not ended:
            action = policy.act(observation[None])[0]
            assert heard["observations"][k].tobytes() == observation.tobytes(), k
            assert heard["actions"][k].tobytes() == action.tobytes(), k
            observation, reward, terminated, truncated, info = environment.step(action)
            ended = terminated or truncated
            assert heard["rewards"][k] == reward and heard["success"][k] == info["success"], k
            images.append(environment.render())
            k += 1
    assert k == len(heard["rewards"]) and heard["success"][-1]
    return images


@pytest.fixture
def user():
    """Somebody who listens to the graph."""
    rclpy.init()
    user = Bench()
    yield user
    user.close()
    rclpy.try_shutdown()


@pytest.mark.parametrize("task, episodes", [("retraction", 2), ("palpation", 1)])
def test_over_topics_observations_images_and_actions_are_bit_for_bit_those_of_the_environment(task, episodes, user, tmp_path):
    save_scene(load_scene(), tmp_path, task, seed=4)
    seen = user.hear(messages.RENDERED_IMAGE)
    with NodeGroup(tmp_path / "logs") as group:
        parameters = ("--params-file", str(tmp_path / "parameters.yaml"))
        logs = lambda: [(log.name, log.read_text()[-800:]) for log in (tmp_path / "logs").iterdir()]  # noqa: E731

        def run(record, **options):
            node = group.start("policy_node", *parameters, record=record, episodes=episodes, **options)
            if "reconstruction_node" not in group.nodes:
                group.start("reconstruction_node", *parameters, output_dir=tmp_path)
            user.until(lambda: record.exists() or group.dead(), logs, 90)
            assert not group.dead(), logs()
            node.interrupt()
            user.until(lambda: node.exit_status is not None, logs)  # images come meanwhile
            assert node.exit_status == 0

        group.start("physics_node", *parameters, device="cpu")
        group.start("rendering_node", *parameters, device="cpu", image_width=64)
        user.until(lambda: user.user.count_publishers("rendered/image_raw"), "the rendering node", 60)
        run(tmp_path / "scripted.npz")
        steps = np.load(tmp_path / "scripted.npz")["episode"]
        last = int((steps == steps[-1]).sum())  # steps of the last episode
        number = lambda message: messages.stamp_to_ns(message.header.stamp) / 40_000_000  # of the step
        # Those of the episode before have the same numbers.
        begun = lambda: 1 + sum(number(b) < number(a) for a, b in pairwise(seen))
        enough = time.monotonic() + 30
        complete = lambda: seen and begun() == episodes and number(seen[-1]) == last
        user.until(lambda: complete() or time.monotonic() > enough, "the last images", 60)
        shown = {}
        for message in seen:
            if number(message) < max(shown, default=0):
                shown = {}  # another episode
            shown[number(message)] = messages.decode_image(message, "rendered")
        if task == "retraction":
            linear_policy().save(tmp_path / "policy.npz")
            run(tmp_path / "learned.npz", policy=tmp_path / "policy.npz")
            other = group.start("policy_node", scene=tmp_path, task="palpation")  # for which other tissue is needed
            wait_until(lambda: "is not that of the scene and the task" in other.log.read_text(), 60, logs)
            assert other.exit_status is None
    images = assert_same_as_environment(tmp_path / "scripted.npz", task, scripted_policy(task), 4, episodes)
    assert len(shown) > last / 2, "of the images; this process, which spins now and then, may miss some"
    np.testing.assert_array_equal(list(shown.values()), [images[int(k)] for k in shown])
    if task == "retraction":
        assert_same_as_environment(tmp_path / "learned.npz", task, linear_policy(), 4, episodes)


@pytest.mark.parametrize(
    "options, sentence",
    [
        ({"task": "suturing"}, "there is no task 'suturing'; there are retraction, palpation"),
        ({"observations": "smell"}, "observations must be state, image or both, got 'smell'"),
        ({"render_mode": "human"}, "render_mode must be rgb_array or None, got 'human'"),
        ({"scene": "no/such/model.ply"}, "no/such/model.ply: no such file"),
        ({"device": "abacus"}, "unknown device 'abacus'"),
        ({"observations": "image", "image_width": 0}, "image_width must be at least 1, got 0"),
    ],
)
def test_mistakes_are_one_sentence(options, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        environments.TaskEnvironment(**{"task": "retraction", "device": "cpu", **options})


@pytest.mark.parametrize(
    "actions, sentence",
    [
        (np.zeros((1, 4)), "retraction: actions must be 2 × 4 numbers, got the shape (1, 4)"),
        (np.array([[0, 0, 0, 1], [0, np.nan, 0, 1]]), "retraction: the action of episode 1 is not finite: [0.0, nan, 0.0, 1.0]"),
    ],
)
def test_a_wrong_action_is_one_sentence_and_changes_nothing(actions, sentence):
    environment = environments.VectorTaskEnvironment("retraction", 2, device="cpu")
    before, _ = environment.reset(seed=1)
    with pytest.raises(ValueError, match=re.escape(sentence)):
        environment.step(actions)
    np.testing.assert_array_equal(environment.batch.observe(), before)


def test_a_model_too_small_for_the_task_is_refused():
    scene = load_scene()
    near = (scene.model.means[:, :2].abs() < 0.012).all(1)
    small = Scene(scene.model.select(near), scene.cameras)
    with pytest.raises(ValueError, match="palpation: no skin node is 0.02 m from where tissue is held; the model is too small"):
        TaskBatch("palpation", small, 1, device="cpu")


def test_without_stable_baselines3_one_sentence_says_what_to_install(tmp_path):
    code = "import sys; sys.modules['stable_baselines3'] = None; from endo_sim_ros.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "train", tmp_path / "out", "--algorithm", "ppo"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    sentence = "endo-sim: PPO needs stable-baselines3, which is not installed; pip install 'endo_sim_ros[rl]'"
    assert done.returncode == 1 and done.stderr.strip() == sentence


def test_without_gymnasium_one_sentence_says_what_to_install():
    code = "import sys; sys.modules['gymnasium'] = None; import endo_sim_ros.learning.train, endo_sim_ros.learning.environments"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stderr.rstrip().endswith("the environments need gymnasium, which is not installed; pip install 'endo_sim_ros[learning]'")


def test_bench_gives_a_row_for_each_number_of_environments(tmp_path, capsys):
    bench_environments(tmp_path / "rows.json", "retraction", (1, 2), "cpu", repeats=1)
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert len(rows) == 4 and all(row["value"] > 0 and row["unit"] == "steps/s" for row in rows)
    assert rows[1]["ratio"] > 0 and rows[1]["peer"] == "1 environment"
    with pytest.raises(ValueError, match="numbers of environments of at least 1, got 4 0"):
        bench_environments(None, "retraction", (4, 0), "cpu")


def test_the_code_in_the_guide_runs(tmp_path):
    guide = (ROOT / "docs" / "learning.md").read_text()
    blocks = re.findall(r"```python\n(.+?)```", guide, re.S)
    if importlib.util.find_spec("stable_baselines3") is None:
        blocks = [block for block in blocks if "stable_baselines3" not in block]
    code = "\n".join(blocks)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "solved: 1.0" in done.stdout


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_the_scripts_solve_as_on_a_cpu_and_images_are_alike():
    for task, count in (("retraction", 256), ("palpation", 64)):
        batch = TaskBatch(task, load_scene(), count, randomisation=Randomisation(stiffness=0.1), images=True, device="cuda")
        _, success, _ = run_episodes(batch, scripted_policy(task, count), np.arange(count))
        assert success.mean() > 0.9, task
    gpu, cpu = (TaskBatch("retraction", load_scene(), 2, "image", device=device) for device in ("cuda", "cpu"))
    for batch in (gpu, cpu):
        batch.reset([0, 1], [np.random.default_rng(s) for s in (0, 1)])
    assert np.abs(gpu.observe().astype(int) - cpu.observe()).mean() < 0.5
