"""The loop of a node."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from ros_bench import S, send_camera
from std_srvs.srv import Trigger
from thorough import mostly_thorough

from endo_sim_ros import messages
from endo_sim_ros.core.config import options
from endo_sim_ros.messages import OK, WARN
from endo_sim_ros.nodes import base
from endo_sim_ros.nodes.base import EndoNode, run
from endo_sim_ros.nodes.configs import NODE_CONFIGS
from endo_sim_ros.nodes.rclpy_private import spin

pytestmark = pytest.mark.dds


INTERRUPTED = """
import os, signal
from endo_sim_ros.nodes.base import EndoNode, run
class Interrupted(EndoNode):
    def __init__(self):
        super().__init__("interrupted")
        self.every(0.01, lambda: os.kill(os.getpid(), signal.SIGINT))
raise SystemExit(run(Interrupted))
"""

STARTED = """
import gc, sys
sys.argv[0] = "-m"
from endo_sim_ros.nodes import base
while_starting = gc.isenabled()
base.spin = lambda node: print(while_starting, gc.isenabled())
raise SystemExit(base.run(lambda: base.EndoNode("started")))
"""


@pytest.mark.parametrize("node", sorted(path.name for path in (Path(__file__).parents[2] / "scripts").glob("*_node")))
def test_help_lists_the_parameters_and_unknown_arguments_are_refused(node, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [f"/somewhere/{node}.py", "--help"])
    assert run(EndoNode) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"usage: ros2 run endo_sim_ros {node} ") and not rclpy.ok()
    (section,) = yaml.safe_load(said[said.index("/**/") :]).values()
    configs = NODE_CONFIGS.get(node) or NODE_CONFIGS[node.removesuffix("_node")]
    assert section["ros__parameters"].keys() <= {option.name for config in configs for option in options(config)}
    assert all(f"{option.name}: " in said for config in configs for option in options(config))
    monkeypatch.setattr(sys, "argv", [f"/somewhere/{node}.py", "--nonsense", "--ros-args", "-p", "world_frame:=map"])
    assert run(EndoNode) == 2 and not rclpy.ok()
    assert capsys.readouterr().err.startswith(f"{node}: unknown argument --nonsense; parameters are given as --ros-args -p ")


def test_garbage_is_collected_once_a_node_spins_and_not_while_it_starts():
    done = subprocess.run([sys.executable, "-c", STARTED], capture_output=True, text=True, timeout=240)
    assert done.stdout == "False True\n", done.stderr


def test_ctrl_c_during_a_callback_is_not_logged_as_its_error():
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=240)
    assert (done.returncode, done.stdout) == (0, "")
    (ready,) = done.stderr.splitlines()
    assert ready.startswith("[INFO]") and ready.endswith("[interrupted]: ready; running")


@pytest.mark.parametrize("when", mostly_thorough(["later", "before"]))
def test_a_second_publisher_of_a_topic_of_ones_own_is_told_until_it_is_gone(bench, monkeypatch, when):
    """One that was there first may be dead: a killed node stays known for a while."""
    monkeypatch.setattr(base, "_DISCOVERED", 1.5)
    monkeypatch.setattr(base, "_FORGOTTEN", 4.0)
    other, elsewhere = rclpy.create_node("twin"), rclpy.create_node("twin", namespace="left")
    arguments = messages.ros_class(messages.GAUSSIANS.type), messages.GAUSSIANS.name, 1
    elsewhere.create_publisher(*arguments)  # another topic
    began = time.monotonic()
    try:
        if when == "before":
            other.create_publisher(*arguments)
        node = EndoNode("owner")
        bench.nodes.append(node)
        bench.executor.add_node(node)
        node.publisher(messages.GAUSSIANS, alone=True)
        bench.spin(2.5)
        assert {level for level, *_ in bench.statuses["owner"]} == {OK}
        if when == "later":
            other.create_publisher(*arguments)
        _, text, _ = bench.status("owner", "running; more than one node publishes /gaussians (", WARN)
        assert "/owner" in text and "/twin" in text and "ROS_DOMAIN_ID" in text and "left" not in text
        assert when == "later" or time.monotonic() - began > 4.0
    finally:
        other.destroy_node()
        elsewhere.destroy_node()
    seen = len(bench.statuses["owner"])
    bench.until(lambda: [s for s in bench.statuses["owner"][seen:] if s[0] == OK], "the end of the warning")


def test_a_node_whose_name_is_not_known_yet_is_told_in_words():
    assert base.publisher_name("/left", "owner") == "/left/owner" and base.publisher_name("/", "owner") == "/owner"
    assert base.publisher_name("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_") == "a node that does not tell its name"


def test_a_node_serves_what_is_there_and_what_is_added_or_removed_meanwhile(bench):
    context = Context()
    rclpy.init(context=context)
    node, ticks, end = EndoNode("loop", context), [], []
    heard = {topic: [] for topic in (messages.CAMERA_POSE, messages.LEFT_INFO)}
    node.subscribe(messages.CAMERA_POSE, heard[messages.CAMERA_POSE].append)

    def exchange(_):
        node.destroy_subscription(next(s for s in node.subscriptions if s.topic_name.endswith("measured_cp")))
        node.subscribe(messages.LEFT_INFO, heard[messages.LEFT_INFO].append)
        node.every(0.02, lambda: ticks.append(0))
        return True, "exchanged"

    def serve():
        try:
            spin(node)
        except ExternalShutdownException as error:
            end.append(error)

    node.service(Trigger, "~/exchange", exchange)
    thread = threading.Thread(target=serve)
    thread.start()
    try:
        for stamp in (1, 2, 3):
            bench.publish(messages.CAMERA_POSE, messages.encode_pose(np.eye(4), stamp * S, "world"))
        bench.until(lambda: [m.header.stamp.sec for m in heard[messages.CAMERA_POSE]] == [1, 2, 3], "poses")
        assert bench.call(Trigger, "/loop/exchange").message == "exchanged" and bench.set("loop", use_sim_time=False)[0]
        send_camera(bench, stamp=4 * S)
        bench.until(lambda: heard[messages.LEFT_INFO] and len(ticks) > 3, "what was added")
        assert len(heard[messages.CAMERA_POSE]) == 3 and thread.is_alive()
    finally:
        rclpy.shutdown(context=context)
        thread.join(60)
        node.destroy_node()
    assert not thread.is_alive() and end
