"""A graph beside another one, and across two machines."""

import os
import shutil
import subprocess
import sys

import pytest
from forked_nodes import HOST, ForkedNodes
from ros_bench import send_model
from waiting import wait_until

from endo_sim_ros import messages
from endo_sim_ros.sequences.bag import BagReader

pytestmark = pytest.mark.dds


@pytest.mark.slow
def test_two_graphs_in_two_domains_do_not_hear_each_other(bench, tmp_path):
    mine = int(os.environ["ROS_DOMAIN_ID"])
    heard = bench.hear(messages.CONTROL_NODES)
    with ForkedNodes(tmp_path / "mine") as near, ForkedNodes(tmp_path / "other") as far:
        far.environment["ROS_DOMAIN_ID"] = str(1 + (mine + 50) % 100)
        near.start("physics_node", node_count=300)
        far.start("rendering_node")
        far.start("recorder_node", bag=tmp_path / "bag")
        bench.status("physics_node", "waiting for a model")
        wait_until((tmp_path / "bag").exists, 30, "the recorder")
        send_model(bench)
        bench.until(lambda: len(heard) > 50, "control nodes")
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) == {messages.DIAGNOSTICS.name}
        nodes = {name for *_, message in bag.messages([messages.DIAGNOSTICS]) for name, *_ in messages.decode_diagnostics(message)}
    assert nodes <= {"recorder", "rendering_node"} and set(bench.statuses) == {"physics_node", "user"}


LISTENER = """
import rclpy
from endo_sim_ros import messages
from endo_sim_ros.nodes.base import quality
from endo_sim_ros.nodes.transport import prepare_transport

prepare_transport()
rclpy.init()
node = rclpy.create_node("listener")
heard = set()


def tell(what):
    if what not in heard:
        heard.add(what)
        print(what, flush=True)


for topic in (messages.GAUSSIANS, messages.CONTROL_NODES, messages.RENDERED_IMAGE):
    node.create_subscription(messages.ros_class(topic.type), topic.name, lambda _, name=topic.name: tell(name), quality(topic))
kind, topic = messages.ros_class(messages.DIAGNOSTICS.type), messages.DIAGNOSTICS
node.create_subscription(kind, topic.name, lambda m: [tell(s.name) for s in m.status], quality(topic))
rclpy.spin(node)
"""


@pytest.fixture
def two_hosts():
    """Names of two network namespaces that only see each other, as two machines at one cable do."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and the command ip")
    names = [f"endo_sim_{os.getpid()}_{side}" for side in "ab"]

    def ip(*arguments):
        return subprocess.run(["ip", *arguments], capture_output=True, text=True)

    try:
        for name in names:
            added = ip("netns", "add", name)
            if added.returncode:
                pytest.skip(f"network namespaces cannot be made here: {added.stderr.strip()}")
        first, second = names
        ip("link", "add", "cable", "netns", first, "type", "veth", "peer", "name", "cable", "netns", second).check_returncode()
        for number, name in enumerate(names, 1):
            for command in (
                f"addr add 10.66.0.{number}/24 dev cable", "link set cable up", "link set lo up", "route add 224.0.0.0/4 dev cable"
            ):  # fmt: skip
                ip("-n", name, *command.split()).check_returncode()
        yield names
    finally:
        for name in names:
            ip("netns", "del", name)


@pytest.mark.thorough
def test_a_graph_works_across_two_machines(two_hosts, small_bag, tmp_path):
    """Bag, reconstruction and a listener on one, physics and rendering on the other; no memory is shared."""
    first, second = two_hosts
    environment = os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    listener = subprocess.Popen(
        ["ip", "netns", "exec", first, sys.executable, "-c", LISTENER], env=environment, stdout=(tmp_path / "heard").open("w")
    )
    try:
        with ForkedNodes(tmp_path / "near") as near, ForkedNodes(tmp_path / "far") as far:
            for group, host in ((near, first), (far, second)):
                group.environment = environment | {HOST: host}
            small = {"iterations": 10, "max_gaussians": 500, "image_width": 48, "keyframes": 2, "start_after": 0.5, "output_dir": tmp_path}
            near.start("reconstruction_node", **small)
            far.start("physics_node", node_count=300)
            far.start("rendering_node", rate=10.0)
            said = lambda: (tmp_path / "heard").read_text().splitlines()  # noqa: E731
            nodes = {"reconstruction_node", "physics_node", "rendering_node"}
            wait_until(lambda: nodes <= {*said()}, 60, lambda: f"all nodes; heard {said()}")
            near.start("bag_player_node", bag=small_bag)
            topics = {"gaussians", "control_nodes", "rendered/image_raw"}
            wait_until(lambda: topics <= {*said()}, 60, lambda: f"{topics}; heard {said()}")
    finally:
        listener.kill()
        listener.wait()
