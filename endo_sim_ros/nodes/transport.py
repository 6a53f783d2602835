"""Settings of Fast DDS, the default middleware of ROS 2 Jazzy, through environment variables. What is set already wins."""

import contextlib
import os
import socket
from collections.abc import MutableMapping
from pathlib import Path

PROFILES = Path(__file__).with_name("fastdds.xml")
SHARED_MEMORY = Path(__file__).with_name("fastdds_shared_memory.xml")


def prepare_transport(environment: MutableMapping[str, str] = os.environ) -> None:
    """Have lost messages repeated soon, and images fit into shared memory; who names transports keeps them. Call it before `rclpy.init`."""
    profiles = PROFILES if environment.get("FASTDDS_BUILTIN_TRANSPORTS") else SHARED_MEMORY
    environment.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profiles))


def graph_environment() -> dict[str, str]:
    """Environment for a graph on one machine, which nothing leaves."""
    environment = dict(os.environ)
    prepare_transport(environment)
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    environment.setdefault("ROS_DOMAIN_ID", str(_free_domain()))  # a graph of our own beside others on this machine
    return environment


def _free_domain() -> int:
    """A ROS domain from 1 to 100 in which no process of this machine takes part; if there is none, any."""
    wanted = 1 + os.getpid() % 100
    for domain in (*range(wanted, 101), *range(1, wanted)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
            probe.bind(("", 7410 + 250 * domain))  # where the first participant of a domain is found (DDSI-RTPS, 9.6.1)
            return domain
    return wanted
