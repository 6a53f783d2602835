"""What we need of rclpy beyond its stable interface, seen with rclpy 7.1.5 (Jazzy)."""

from rclpy.node import Node


def given_parameters(node: Node) -> frozenset[str]:
    """The names of the parameters that a node was started with, declared or not; ROS itself tells only those declared."""
    return frozenset(node._parameter_overrides)
