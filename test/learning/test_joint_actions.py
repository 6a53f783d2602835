"""Actions of joints."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from played_tasks import IDS, make, play
from thorough import mostly_thorough

from endo_sim_ros.instruments import JOINTS
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.tasks import TASKS


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["joints", pytest.param("joint_positions", marks=pytest.mark.thorough)])
@pytest.mark.parametrize("task", mostly_thorough((name for name, task in TASKS.items() if not task.turns), 3))
def test_gymnasium_finds_nothing_to_complain_about(task, actions):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(task, actions=actions, observations="both").unwrapped)


@pytest.mark.slow
def test_joints_that_follow_a_script_solve_the_task_as_the_script_does():
    """What the arm would do for actions of the tip, as positions of its joints, has the same outcome."""
    tips, script = make(observations="both", segmentation=True), scripted_policy("retraction")
    environment = make(actions="joint_positions")
    seen, rewards, info = play(tips, script, 0)
    assert info["success"]
    observation, _ = tips.reset(seed=0)
    state, _ = environment.reset(seed=0)
    names = environment.unwrapped.batch.observation_names
    assert names[-6:] == JOINTS and state.shape == (len(names),)
    for expected in rewards:
        np.testing.assert_allclose(state[:-6], observation["state"], atol=2e-4)
        np.testing.assert_allclose(state[-6:], tips.unwrapped.batch.tools.scaled()[0], atol=1e-6)
        action = script.act(observation["state"][None])[0]
        observation, *_ = tips.step(action)
        joints = np.append(tips.unwrapped.batch.tools.scaled()[0], action[3])
        state, reward, *_, info = environment.step(joints)
        assert reward == pytest.approx(expected, abs=1e-3)
    assert info["success"]


def test_deltas_move_joints_by_their_units_and_limits_hold():
    environment = make(actions="joints")
    environment.reset(seed=1)
    batch = environment.unwrapped.batch
    batch.task.tip[:] = 0, 0, 0.01  # away from its limits
    batch.tools.begin(np.array([0]), batch._poses())
    before, tip = batch.tools.joints.copy(), batch.task.tip.copy()
    environment.step(np.array([0.5, -0.5, -0.5, 1, -1, 0.3, -1]))
    np.testing.assert_allclose(batch.tools.joints - before, batch.tools.steps * [[0.5, -0.5, -0.5, 1, -1, 0.3]], atol=1e-9)
    assert 1e-4 < np.linalg.norm(batch.task.tip - tip) < 0.01
    np.testing.assert_allclose(batch.task.rotations[0], batch.tools.poses()[0, :3, :3])
    for _ in range(40):  # out of where the task allows the tip
        environment.step(np.array([0, 0, -1, 0, 0, 0, -1]))
    low, high = batch.task.low, batch.task.high
    assert (batch.task.tip >= np.array(low) - 1e-6).all() and (batch.task.tip <= np.array(high) + 1e-6).all()
    at = batch.tools.poses()[:, :3, 3]
    np.testing.assert_allclose(batch.task.find(at), batch.task.tip, atol=1e-9)
    np.testing.assert_array_equal(batch.tissue.tools.tips[0, 0].numpy(), at[0])


@pytest.mark.slow
def test_each_of_many_is_the_single_one_with_its_seed():
    count, rng = 3, np.random.default_rng(0)
    many = gymnasium.make_vec(
        IDS["retraction"], num_envs=count, vectorization_mode="vector_entry_point", actions="joints", observations="both", device="cpu"
    )
    single = make(actions="joints", observations="both")
    observations, _ = many.reset(seed=7)
    observation, _ = single.reset(seed=8)
    for _ in range(12):
        for name, value in observation.items():
            np.testing.assert_array_equal(observations[name][1], value)
        actions = rng.uniform(-1, 1, (count, 7))
        observations, *_ = many.step(actions)
        observation, *_ = single.step(actions[1])


def test_a_wrong_action_is_one_sentence():
    environment = make(actions="joints").unwrapped
    environment.reset(seed=0)
    with pytest.raises(ValueError, match=r"retraction: actions must be 1 × 7 numbers, got the shape \(1, 4\)"):
        environment.step(np.zeros(4))
    with pytest.raises(ValueError, match="actions must be cartesian, joints or joint_positions, got 'feet'"):
        make(actions="feet")
