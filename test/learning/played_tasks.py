"""Tasks, made and played."""

import hashlib

import gymnasium
import numpy as np

import endo_sim_ros.learning.environments  # noqa: F401  (registers them)
from endo_sim_ros.instruments import JOINTS
from endo_sim_ros.learning.policies import NetworkPolicy, scripted_policy
from endo_sim_ros.learning.tasks import TASKS

IDS = {name: f"endo_sim_ros/{name.capitalize()}-v0" for name in TASKS}
VARIED = {
    "stiffness": 0.4, "light": 0.5, "texture": 0.5, "camera_position": 0.005, "camera_angle": 5.0,
    "tool": 0.8, "trocar_angle": 15.0, "trocar_position": 0.01, "metal": 0.5, "lamp": 0.004,
}  # fmt: skip


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


def first_steps(task):
    """Number of steps of the script in which all that its tools do begins: they touch within 15, or never, and cut later."""
    return 40 if TASKS[task].cutting else 20


def digest(task):
    """What identifies all that is seen and rewarded in the first steps of the script."""
    seen, rewards, _ = play(make(task, observations="both", randomisation=VARIED), scripted_policy(task), 3, first_steps(task))
    return hashlib.sha256(b"".join(o[k].tobytes() for o in seen for k in o) + repr(rewards).encode()).hexdigest()


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


def joint_policy():
    """Weights by hand that act by joints: down to the skin, closed there, a little up, all the while turning."""
    names = TASKS["retraction"].observation_names + JOINTS
    weights = np.zeros((len(names) + 1, 7))
    weights[names.index("tip_z"), [2, 6]], weights[names.index("jaw"), [2, 6]] = (5, -8), (-1.5, 1)
    weights[-1] = 0.1, -0.05, 0, 0.5, 0.2, -0.3, 2
    weights[names.index("wrist_yaw"), 0] = 0.3
    return NetworkPolicy("retraction", [weights], "joints")
