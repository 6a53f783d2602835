"""The process of a ROS node."""

import ctypes
import os
import socket
import subprocess
import sys
from xml.etree import ElementTree

import pytest

from endo_sim_ros.nodes.listeners import _SETTLED
from endo_sim_ros.nodes.transport import PROFILES, SHARED_MEMORY, graph_environment

_FAULTS = """
import resource
from endo_sim_ros.nodes.process import keep_memory
{prepare}
def take():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        images = [bytes(1 << 20) + bytes([k]) for k in range(4)]  # as many copies as an image has on its way
        del images
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
take()
print(take())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="the C library is not glibc")
def test_memory_of_an_image_is_not_fetched_anew_for_the_next() -> None:
    def pages(prepare: str) -> int:
        return int(subprocess.run([sys.executable, "-c", _FAULTS.format(prepare=prepare)], capture_output=True, check=True).stdout)

    assert pages("keep_memory()") < 0.1 * pages("")


def test_who_waits_until_all_listen_waits_longer_than_a_process_takes_to_announce_itself_again() -> None:
    announced = ElementTree.parse(PROFILES).find(".//{*}participant//{*}leaseAnnouncement/{*}sec")
    assert announced is not None and float(announced.text or 0) < _SETTLED


FAST_DDS = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
_SEGMENTS = """
import os, rclpy
from endo_sim_ros.nodes.transport import prepare_transport
prepare_transport()
rclpy.init()
node = rclpy.create_node("shares_memory")
mapped = {line.split()[-1] for line in open("/proc/self/maps") if "/dev/shm/fastrtps_" in line}
print(max(map(os.path.getsize, mapped), default=0))
node.destroy_node()
rclpy.shutdown()
"""


@pytest.mark.skipif(not os.path.isdir("/dev/shm"), reason="processes share memory elsewhere")
def test_images_fit_into_the_memory_that_processes_share_unless_transports_are_named() -> None:
    def largest(**named: str) -> int:
        chosen = ("FASTDDS_BUILTIN_TRANSPORTS", "FASTRTPS_DEFAULT_PROFILES_FILE")
        environment = {name: value for name, value in os.environ.items() if name not in chosen} | named | FAST_DDS
        done = subprocess.run([sys.executable, "-c", _SEGMENTS], env=environment, capture_output=True, text=True, check=True)
        if "Error" in done.stdout:  # Fast DDS tells it there
            pytest.skip("/dev/shm is full")
        return int(done.stdout)

    stereo, depth = 2 * 640 * 512 * 3, 640 * 512 * 4
    assert largest() > 2 * (stereo + depth)  # what is being read, and what is being written
    assert 0 < largest(FASTDDS_BUILTIN_TRANSPORTS="DEFAULT") < stereo


def test_both_profiles_differ_in_their_transport_alone() -> None:
    def without_transports(file: str) -> str:
        root = ElementTree.parse(file).getroot()
        for parent in list(root.iter()):
            for child in [child for child in parent if child.tag.rpartition("}")[2] in ("transport_descriptors", "userTransports")]:
                parent.remove(child)
        return ElementTree.canonicalize(ElementTree.tostring(root, "unicode"), strip_text=True)

    assert without_transports(str(PROFILES)) == without_transports(str(SHARED_MEMORY))


def test_a_graph_of_its_own_takes_a_domain_in_which_nobody_is(monkeypatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    first = int(graph_environment()["ROS_DOMAIN_ID"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 7410 + 250 * first))
        second = int(graph_environment()["ROS_DOMAIN_ID"])
    assert second != first and {first, second} <= set(range(1, 101))
    listens = "import rclpy, sys; rclpy.init(); node = rclpy.create_node('n'); print('ready', flush=True); sys.stdin.read()"
    environment = graph_environment()
    with subprocess.Popen([sys.executable, "-c", listens], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as node:
        assert node.stdin is not None and node.stdout is not None and node.stdout.readline() == b"ready\n"
        assert graph_environment()["ROS_DOMAIN_ID"] != environment["ROS_DOMAIN_ID"]
        node.stdin.close()
