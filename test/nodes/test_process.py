"""The process of a ROS node."""

import ctypes
import subprocess
import sys
from xml.etree import ElementTree

import pytest

from endo_sim_ros.nodes.listeners import _SETTLED
from endo_sim_ros.nodes.transport import PROFILES

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
