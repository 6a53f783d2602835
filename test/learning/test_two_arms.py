"""Tasks of two arms."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from played_tasks import make, play

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.instruments import JOINTS, LINKS
from endo_sim_ros.instruments.drawing import FIRST_LINK
from endo_sim_ros.learning.actions import ARM_NAMES
from endo_sim_ros.learning.config import DemonstrationConfig, ImitationConfig, SightConfig
from endo_sim_ros.learning.demonstrations import demonstrate
from endo_sim_ros.learning.graph_files import save_scene
from endo_sim_ros.learning.lerobot_policy import write_training
from endo_sim_ros.learning.policies import make_policy, scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import TASKS, find_task

FIXED = "endo_sim_ros.learning.tasks.tension:FixedTension"


def begun(count=2, task="tension", **options):
    batch = TaskBatch(task, load_scene(), count, device="cpu", **options)
    batch.reset(range(count), [np.random.default_rng(seed) for seed in range(count)])
    return batch


def test_each_arm_has_its_part_of_actions_and_of_what_is_measured():
    batch = begun(observations="sensors", sight=SightConfig(image_width=96, segmentation=True))
    before = batch.task.tip.copy()
    action = np.array([[-1, 0.5, -1, -1, 1, 0, -0.5, 1]] * 2)
    for step in range(1, 6):
        seen, _ = batch.step(action)
        wanted = before + step * 0.002 * action.reshape(2, 2, 4)[..., :3]
        np.testing.assert_allclose(batch.task.tip, np.clip(wanted, batch.task.low, batch.task.high), atol=1e-12)
    measured = seen["arm"].reshape(2, 2, len(ARM_NAMES))
    to_eye = invert_pose(batch.task.endoscope)
    np.testing.assert_allclose(measured[..., :3], batch.task.tips() @ to_eye[:3, :3].T + to_eye[:3, 3], atol=1e-6)
    np.testing.assert_array_equal(measured[..., 7], [[np.float32(0.6), 0]] * 2)  # the left jaw is closed
    for labels in seen["segmentation"]:
        ours = np.arange(len(LINKS)) + FIRST_LINK
        right, left = (np.argwhere(np.isin(labels[..., 0], arm)) for arm in (ours, ours + len(LINKS)))
        assert len(right) > 20 and len(left) > 20 and right[:, 1].mean() > left[:, 1].mean() + 20
    assert make_policy("still", "tension").act(np.zeros((3, 33))).shape == (3, 8)
    with pytest.raises(ValueError, match=r"tension: actions must be 2 × 8 numbers, got the shape \(2, 4\)"):
        batch.step(action[:, :4])


def test_the_tissue_is_taut_when_both_arms_pull_and_too_much_of_either_ends_it(monkeypatch):
    batch, script = begun(4), scripted_policy("tension", 4)
    solved, states = np.zeros(4, bool), batch.observe()
    for _ in range(batch.task.horizon):
        states, outcome = batch.step(script.act(states))
        o = dict(zip(batch.observation_names, states.T))
        for b in np.flatnonzero(outcome.success & ~solved):
            assert o["held"][b] == pytest.approx(1 - 1 / batch.task.hold)  # it is counted after it is observed
            tips = np.array([[o[f"{arm}.tip_{axis}"][b] for axis in "xyz"] for arm in batch.task.arms])
            forces = np.array([[o[f"{arm}.force_{axis}"][b] for axis in "xyz"] for arm in batch.task.arms])
            way = (tips[1] - tips[0]) / np.linalg.norm(tips[1] - tips[0])
            np.testing.assert_allclose(
                forces @ way * [1, -1], [o["wanted"][b] - o[f"{arm}.missing"][b] for arm in batch.task.arms], atol=1e-5
            )
            np.testing.assert_allclose(forces @ way * [1, -1], o["wanted"][b], rtol=batch.task.tolerance)
            if b == 0:
                right, left = forces @ way * [1, -1]
                pulls = f"pull with {o['wanted'][0]:.2f} N each, ± 15%: PSM1 {right:.2f} N, PSM2 {left:.2f} N"
                assert batch.task.goal_lines() == (pulls, "taut for 10 of 10 steps")
        solved |= outcome.success
    assert solved.all()
    monkeypatch.setattr(TASKS["tension"], "force_limit", 0.1)
    _, rewards, info = play(make("tension"), scripted_policy("tension"), 0)
    assert len(rewards) < 40 and not info["success"] and info["force"].max() > 0.1 and rewards[-1] < 0


def test_spots_are_apart_from_left_to_right_and_a_fixed_force_changes_nothing_else(monkeypatch):
    batch, fixed = begun(32), begun(32, FIXED)
    right, left = np.moveaxis(batch.task.find(batch.task.rest[batch.task.sites]), 1, 0)
    far = np.linalg.norm(right - left, axis=1)
    assert (far >= 0.02).all() and (far <= 0.03).all() and (right[:, 0] - left[:, 0] > 0.8 * far).all()
    np.testing.assert_allclose(right + left, 0, atol=1e-12)
    np.testing.assert_array_equal(fixed.task.sites, batch.task.sites)
    assert (fixed.task.wanted == 1).all() and np.ptp(batch.task.wanted) > 0.3
    other = np.flatnonzero((fixed.observe() != batch.observe()).any(0))
    assert [batch.observation_names[i] for i in other] == ["PSM1.missing", "PSM2.missing", "wanted"]
    monkeypatch.setattr(TASKS["tension"], "apart", (0.2, 0.3))
    with pytest.raises(ValueError, match=r"tension: no two places of the skin are 0.2 to 0.3 m apart; the model is too small"):
        begun(1)


@pytest.mark.slow
def test_joints_of_both_arms_that_follow_the_script_solve_the_task():
    tips, script = make("tension", observations="both", segmentation=True), scripted_policy("tension")
    environment = make("tension", actions="joint_positions")
    observation, _ = tips.reset(seed=2)
    state, _ = environment.reset(seed=2)
    names = environment.unwrapped.batch.observation_names
    assert names[-12:] == tuple(f"{arm}.{joint}" for arm in ("PSM1", "PSM2") for joint in JOINTS) and state.shape == (len(names),)
    done, info = False, {}
    while not done:
        np.testing.assert_allclose(state[:-12], observation["state"], atol=2e-3)
        action = script.act(observation["state"][None])[0]
        observation, *_ = tips.step(action)
        joints = np.column_stack([tips.unwrapped.batch.tools.scaled(), action.reshape(2, 4)[:, 3]])
        state, _, terminated, truncated, info = environment.step(joints.ravel())
        done = terminated or truncated
    assert info["success"]


@pytest.mark.slow
def test_demonstrations_name_the_columns_by_arm_and_repeat_in_the_environment(tmp_path):
    out = tmp_path / "out"
    config = DemonstrationConfig(episodes=2, noise=0.0, environments=2, images="png")
    demonstrate("tension", ["phantom:0"], out, config, SightConfig(image_width=40), device="cpu")
    features = json.loads((out / "meta/info.json").read_text())["features"]
    both = lambda names: [f"{arm}.{name}" for arm in ("PSM1", "PSM2") for name in names]
    assert features["action"]["names"] == both(["x", "y", "z", "fourth"])
    assert features["observation.state"]["names"] == both(ARM_NAMES) and features["observation.state.joint_positions"]["names"] == both(
        JOINTS
    )
    table = pq.read_table(next(out.glob("data/*/*.parquet")))
    columns = {
        name: np.array(table.column(name).to_pylist(), np.float32) for name in ("observation.state", "action", "action.cartesian_absolute")
    }
    for arm in range(2):
        way = columns["action.cartesian_absolute"][:, 8 * arm :][:, :3] - columns["observation.state"][:, 11 * arm :][:, :3]
        asked = columns["action"][:, 4 * arm :][:, :3]
        inside = (np.abs(asked) < 1).all(1)
        np.testing.assert_allclose(np.linalg.norm(way[inside], axis=1), 0.002 * np.linalg.norm(asked[inside], axis=1), atol=2e-6)
    environment = make("tension")
    environment.reset(seed=table.column("seed")[0].as_py())
    for action in columns["action"]:
        *_, info = environment.step(action)
    assert info["success"]
    policy = json.loads(write_training(out, tmp_path / "act", ImitationConfig()).read_text())["policy"]
    assert policy["output_features"]["action"]["shape"] == [8] and policy["input_features"]["observation.state"]["shape"] == [22]


def test_a_scene_has_both_arms_with_tools_of_their_own(tmp_path):
    save_scene(load_scene(), tmp_path, "tension", seed=4)
    text = (tmp_path / "parameters.yaml").read_text()
    sections = {name: section["ros__parameters"] for name, section in yaml.safe_load(text).items()}
    physics, rendering = sections["/**/physics_node"], sections["/**/rendering_node"]
    assert physics["arms"] == rendering["arms"] == ["PSM1", "PSM2"] and "*id" not in text  # which rcl does not read
    held = [(tmp_path / arm / "PROGRASP_FORCEPS_400093.json") for arm in ("PSM1", "PSM2")]
    assert physics["instruments"] == [str(path.resolve()) for path in held]
    assert json.loads(held[0].read_text()) != json.loads(held[1].read_text())
    x = [float(frame.split()[1]) for frame in physics["frames"]]
    assert x[0] == pytest.approx(-x[1]) and x[0] > 0.03
    assert find_task("tension").arms == ("PSM1", "PSM2")


@pytest.mark.slow
def test_tissue_that_is_taut_beside_its_spots_does_not_count():
    batch, script = begun(8), scripted_policy("tension")
    states, solved = batch.observe(), np.zeros(8, bool)
    for _ in range(batch.task.horizon):
        ways = states[:, 6:12].reshape(-1, 2, 3) + [0, 0.6, 0]  # as if both spots were 12 mm higher in the picture
        beside = np.concatenate([states[:, :6], ways.reshape(-1, 6), np.linalg.norm(ways, axis=2), states[:, 14:]], 1)
        states, outcome = batch.step(script.act(beside))
        solved |= outcome.success
    assert not solved.any()


def test_arms_that_run_into_each_other_are_told():
    environment = make("tension", observations="both")
    _, info = environment.reset(seed=2)
    assert info["overlap"] == 0
    task, deepest = environment.unwrapped.batch.task, []
    for _ in range(40):
        middle = task.tip[0].mean(0) + [0, 0, 0.002]  # above the tissue
        moves = np.column_stack([(middle - task.tip[0]) / task.step_length, [-1, -1]])
        *_, info = environment.step(moves.ravel().clip(-1, 1))
        deepest.append(info["overlap"])
    assert deepest[0] == 0 and max(deepest) > 0.001 and np.linalg.norm(task.tip[0, 0] - task.tip[0, 1]) < 0.002
