"""Settings of Fast DDS, the default middleware of ROS 2 Jazzy, through environment variables. What is set already wins."""

import os
from collections.abc import MutableMapping
from pathlib import Path

PROFILES = Path(__file__).with_name("fastdds.xml")
_SOCKETS = 4_000_000  # bytes; with socket buffers larger than the system's limit Fast DDS receives nothing
_LARGE_DATA = "LARGE_DATA?max_msg_size=1MB&sockets_size=4MB&non_blocking=true&tcp_negotiation_timeout=50"


def prepare_transport(environment: MutableMapping[str, str] = os.environ) -> None:
    """Have lost messages repeated soon; must run before rclpy starts."""
    environment.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILES))


def graph_environment() -> dict[str, str]:
    """Environment for a graph on one machine: nothing leaves it, and large messages travel fast."""
    environment = dict(os.environ)
    prepare_transport(environment)
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    environment.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))  # a graph of our own beside others on this machine
    try:
        limit = int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        limit = 0
    if limit >= _SOCKETS:
        environment.setdefault("FASTDDS_BUILTIN_TRANSPORTS", _LARGE_DATA)
    return environment
