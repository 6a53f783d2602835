"""What all nodes share: parameters from configurations, diagnostics, guarded callbacks, start and stop."""

import sys
import time
from collections.abc import Callable
from typing import Any, TypeVar

import rclpy
import torch
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from endo_sim_ros import messages
from endo_sim_ros.config import ConfigError, StageConfig, options
from endo_sim_ros.messages import ERROR, OK, WARN, Topic

_ERROR_SHOWN = 5.0  # seconds that an error stays on /diagnostics
STREAM_DEPTH = 20

Config = TypeVar("Config", bound=StageConfig)


class EndoNode(Node):
    """A node whose callbacks may fail without taking it down: what went wrong is one sentence on /diagnostics."""

    def __init__(self, name: str):
        super().__init__(name)
        torch.set_num_threads(1)  # the kernels bring their own threads
        self._configs: dict[type, StageConfig] = {}
        self._diagnostics = self.publisher(messages.DIAGNOSTICS)
        self._error_text, self._error_until, self.error_count = "", 0.0, 0
        self._logged: dict[str, float] = {}
        self.create_timer(1.0, self.publish_diagnostics)

    # ------------------------------------------------------------- parameters

    def declare(self, config_class: type[Config]) -> Config:
        """Declare every field of a configuration as a parameter and return the configuration that they give.

        Raises:
            ConfigError: If a value given at start cannot be used.
        """
        values = {}
        for option in options(config_class):
            descriptor = ParameterDescriptor(description=option.description)
            if option.choices:
                descriptor.additional_constraints = "one of " + ", ".join(option.choices)
            if option.range and option.type is float:
                bounds = FloatingPointRange(from_value=float(option.range.minimum), to_value=float(option.range.maximum))
                descriptor.floating_point_range = [bounds]
            elif option.range:
                bounds = IntegerRange(from_value=int(option.range.minimum), to_value=int(option.range.maximum), step=1)
                descriptor.integer_range = [bounds]
            try:
                values[option.name] = self.declare_parameter(option.name, option.default, descriptor).value
            except Exception as error:  # rclpy has one exception type for each way a value can be wrong
                raise ConfigError(f"parameter {option.name}: {error} ({option.description})") from error
        self._configs[config_class] = config_class.from_mapping(values)
        if len(self._configs) == 1:
            self.add_on_set_parameters_callback(self._on_set_parameters)
        return self._configs[config_class]

    def config_changed(self, config: StageConfig) -> None:
        """Called with a whole, valid configuration after one of its parameters was set; override to use it."""

    def _on_set_parameters(self, parameters: list) -> SetParametersResult:
        new = {parameter.name: parameter.value for parameter in parameters}
        changed = []
        for config_class, config in self._configs.items():
            mine = {name: value for name, value in new.items() if hasattr(config, name)}
            try:
                if mine:
                    changed.append(config_class.from_mapping(vars(config) | mine))
            except ConfigError as error:
                return SetParametersResult(successful=False, reason=str(error))
        for config in changed:
            try:
                self.config_changed(config)
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
            self._configs[type(config)] = config
        return SetParametersResult(successful=True)

    # ----------------------------------------------------------------- topics

    def publisher(self, topic: Topic) -> Any:
        return self.create_publisher(messages.ros_class(topic.type), topic.name, quality(topic))

    def subscribe(self, topic: Topic, callback: Callable[[Any], None], depth: int = STREAM_DEPTH, reliable: bool = True) -> None:
        """Subscribe with a callback whose errors are reported instead of raised."""

        def guarded(message: Any) -> None:
            with self.guard(topic.name):
                callback(message)

        self.create_subscription(messages.ros_class(topic.type), topic.name, guarded, quality(topic, depth, reliable))

    def now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    # ------------------------------------------------------------ diagnostics

    def guard(self, where: str) -> "_Guard":
        """Context that reports what its block raises; the node lives on."""
        return _Guard(self, where)

    def report_error(self, text: str) -> None:
        """Publish an error now and show it on /diagnostics for a while; repeated ones are logged every few seconds."""
        self.error_count += 1
        self._error_text, self._error_until = text, time.monotonic() + _ERROR_SHOWN
        if time.monotonic() - self._logged.get(text, -1e9) > _ERROR_SHOWN:
            if len(self._logged) > 100:
                self._logged.clear()
            self._logged[text] = time.monotonic()
            self.get_logger().error(text)
            self.publish_diagnostics()

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, sentence and values of the node's normal state; override."""
        return OK, "running", {}

    def publish_diagnostics(self) -> None:
        try:
            level, text, values = self.status()
        except Exception as error:  # a fault in describing the state must not end the node
            level, text, values = ERROR, f"status: unexpected {type(error).__name__}: {error}", {}
        if time.monotonic() < self._error_until:
            level, text = ERROR, self._error_text
        values = values | {"errors": self.error_count}
        name = self.get_fully_qualified_name().lstrip("/")
        self._diagnostics.publish(messages.encode_diagnostics(name, level, text, values, self.now_ns()))


class _Guard:
    def __init__(self, node: EndoNode, where: str):
        self._node, self._where = node, where

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, _: Any) -> bool:
        if error is None or not isinstance(error, Exception) or isinstance(error, ExternalShutdownException):
            return False
        expected = isinstance(error, ValueError)  # the errors of this package are sentences for the user
        self._node.report_error(str(error) if expected else f"{self._where}: unexpected {type(error).__name__}: {error}")
        return True


def quality(topic: Topic, depth: int = STREAM_DEPTH, reliable: bool = True) -> QoSProfile:
    """Quality of service of a topic: reliable; latched topics keep their last message for late joiners."""
    latched = topic.qos == "latched"
    return QoSProfile(
        depth=1 if latched else depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def run(node_class: Callable[[], EndoNode]) -> int:
    """Start ROS, spin a node until it is told to stop, and return the exit status."""
    rclpy.init(args=sys.argv)
    node = None
    try:
        node = node_class()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ConfigError as error:
        print(f"{node_class.__name__}: {error}", file=sys.stderr)
        return 2
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


__all__ = ["ERROR", "OK", "WARN", "EndoNode", "run"]
