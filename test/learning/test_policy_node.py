"""Tasks over topics are, bit for bit, those of the environment."""

import signal
import time
from itertools import pairwise

import numpy as np
import pytest
import rclpy
from played_tasks import linear_policy, make
from ros_bench import Bench
from waiting import wait_until

from endo_sim_ros import messages
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import load_scene, save_scene

pytestmark = pytest.mark.dds


def assert_same_as_environment(record, task, policy, seed, episodes):
    """The steps in a file are, bit for bit, those of the environment; returns its images of the last episode, the first at rest."""
    heard, environment, k = np.load(record), make(task, render_mode="rgb_array", instrument=False), 0
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


@pytest.mark.slow
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
            node.process.send_signal(signal.SIGINT)
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
