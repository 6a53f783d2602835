"""Fixtures of the tests of graph."""

import pytest
import rclpy
from ros_bench import Bench


@pytest.fixture
def bench():
    """A user of the graph, and no node beside it in this process."""
    rclpy.init()
    bench = Bench()
    yield bench
    bench.close()
    rclpy.try_shutdown()
