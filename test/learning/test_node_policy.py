"""A ROS node of a user as a policy of the leaderboard."""

import contextlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
import rclpy
from endo_sim_command import endo_sim_here
from played_tasks import linear_policy

from endo_sim_ros.graph import node_policy
from endo_sim_ros.learning.benchmark import benchmark, read_results
from endo_sim_ros.learning.config import BenchmarkConfig

pytestmark = [pytest.mark.dds, pytest.mark.slow]
GUIDE = (Path(__file__).parents[2] / "docs/learning.md").read_text()
SIZE = "--image-width", 32, "--scenes", "phantom:0", "--device", "cpu"


@pytest.fixture(autouse=True)
def ros():
    """Whatever a test does with ROS in this process ends with it."""
    yield
    rclpy.try_shutdown()


@contextlib.contextmanager
def running(*words):
    """A process of a user."""
    process = subprocess.Popen([sys.executable, *words], stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.communicate(timeout=10)
        except subprocess.TimeoutExpired:  # rclpy's own end has hung once
            process.kill()
            process.communicate()


def test_the_node_of_the_guide_plays_as_the_same_policy_in_this_process_does(tmp_path):
    (code,) = (block for block in re.findall(r"```python\n(.+?)```", GUIDE, re.S) if "class Lifter(Node)" in block)
    assert code.count("\n") < 40
    (tmp_path / "lifter.py").write_text(code)
    with running(tmp_path / "lifter.py") as node:
        done = endo_sim_here("benchmark", tmp_path / "out", "node:lifter", "--episodes", 3, *SIZE)
        assert done.returncode == 0, done.stderr
        assert node.poll() is None
    (found,) = read_results(tmp_path / "out")
    linear_policy().save(tmp_path / "same.npz")
    config = BenchmarkConfig(episodes=3, image_width=32)
    (same,) = benchmark(tmp_path / "other", [str(tmp_path / "same.npz")], ["phantom:0"], config, "cpu")
    assert (found.policy, found.episodes, found.solved, found.mean_steps) == ("node:lifter", 3, same.solved, same.mean_steps)
    assert found.solved and found.mean_return == pytest.approx(same.mean_return, abs=1e-9)
    assert len(list((tmp_path / "out").glob("retraction-*lifter.mp4"))) == 1


@pytest.fixture(scope="module")
def seeker(tmp_path_factory):
    """What the policy that the nodes below run solves in this process, in their first episode."""
    named = f"{Path(__file__).parent / 'blue_seeker.py'}:BlueSeeker"
    (found,) = benchmark(tmp_path_factory.mktemp("seeker"), [named], ["phantom:0"], BenchmarkConfig(episodes=1, image_width=32), "cpu")
    return found


@pytest.mark.parametrize(
    "name, sentence",
    [
        pytest.param("silent", "silent did not answer the observation of 0.04 s on silent/action (waited 2 s)", marks=pytest.mark.thorough),
        ("lost", "lost/action: expected 4 finite numbers in position, got [nan"),
    ],
)
def test_a_node_that_sees_plays_and_what_goes_wrong_is_a_sentence_after_which_finished_episodes_are_kept(name, sentence, tmp_path, seeker):
    with running(Path(__file__).parent / "node_policy.py", name):
        sight = "--sight.image-width", 48, "--sight.eyes", 2
        done = endo_sim_here("benchmark", tmp_path / "out", f"node:{name}", "--episodes", 3, *SIZE, *sight, "--patience", 2)
    assert done.returncode in (1, 2) and sentence in done.stderr and "Traceback" not in done.stderr, done.stderr
    (found,) = read_results(tmp_path / "out")
    assert (found.episodes, found.solved, found.mean_steps) == (1, seeker.solved, seeker.mean_steps)
    assert found.mean_return == pytest.approx(seeker.mean_return, abs=1e-6)
    assert "node:" in (tmp_path / "out" / "benchmark.html").read_text()


def test_a_node_that_is_not_there_is_awaited_and_named(monkeypatch):
    monkeypatch.setattr(node_policy, "_STARTS", 1.0)
    with pytest.raises(RuntimeError, match="no node nobody that subscribes to nobody/observation and publishes nobody/action"):
        node_policy.NodePolicy("nobody", "retraction", patience=0.5)


@pytest.mark.parametrize("name", ["", "/", "my lifter", "3d"])
def test_a_name_that_no_node_has_is_refused_at_once(name):
    with pytest.raises(ValueError, match=f"node:{name} names no ROS node; give letters, digits and _ after the colon"):
        node_policy.NodePolicy(name, "retraction")
