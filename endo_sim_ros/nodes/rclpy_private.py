"""What we need of rclpy beyond its stable interface, seen with rclpy 7.1.5 (Jazzy)."""

from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

_WAKE_EVERY = 1.0  # seconds; see spin


def spin(node: Node) -> None:
    """Run the callbacks of a node one after another until ROS is shut down.

    `EventsExecutor` is experimental, and there since rclpy 7.1.4. With 500 messages and 100 timer calls per second it needs
    half the processor time of `SingleThreadedExecutor`, which gathers anew, in Python, what a node may wait for, twice
    for each message. Its ``spin()``, which waits without a time limit, never wakes in the wheels of PyPI; ``spin_once``
    with a time limit does.

    Raises:
        KeyboardInterrupt, rclpy.executors.ExternalShutdownException: If a signal ends it.
    """
    executor = EventsExecutor(context=node.context)
    executor.add_node(node)
    try:
        while node.context.ok():
            executor.spin_once(timeout_sec=_WAKE_EVERY)
    finally:
        executor.shutdown()


def given_parameters(node: Node) -> frozenset[str]:
    """The names of the parameters that a node was started with, declared or not; ROS itself tells only those declared."""
    return frozenset(node._parameter_overrides)


def set_empty(node: Node, name: str) -> None:
    """Give a declared parameter without a value the empty list of texts: whoever reads it among others would get none of them.

    Declared with that list it would be one of bytes, and an event tells of what is set.
    """
    node._parameters[name] = Parameter(name, Parameter.Type.STRING_ARRAY, [])
