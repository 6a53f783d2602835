"""What all nodes share: parameters from configurations, diagnostics, guarded callbacks, start and stop."""

import contextlib
import difflib
import functools
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import rclpy
import torch
import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException, NameValidationException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from endo_sim_ros import hear_interrupts, messages
from endo_sim_ros.core.config import ConfigError, StageConfig, options
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import ModelError
from endo_sim_ros.messages import ERROR, OK, WARN, MessageError, Topic
from endo_sim_ros.nodes.configs import NODE_CONFIGS
from endo_sim_ros.nodes.executor import NodeExecutor
from endo_sim_ros.nodes.process import end_with_parent
from endo_sim_ros.nodes.transport import prepare_transport

_ERROR_SHOWN = 5.0  # seconds that an error stays on /diagnostics, and that its repetitions are not logged
_MOST_LOGGED = 10  # different errors logged in that time: one whose text differs at 500 Hz must not flood the log
_LONGEST_ERROR = 1000  # characters; a sentence may quote what came, and that may be megabytes
_END_WITHIN = 3.0  # seconds that worker threads have to end before the process ends without them
STREAM_DEPTH = 20

Config = TypeVar("Config", bound=StageConfig)


class EndoNode(Node):
    """A node whose callbacks may fail without taking it down: what went wrong is one sentence on /diagnostics."""

    read_at_start: frozenset[str] = frozenset()  # parameters that act at start only; all others act when they are set

    def __init__(self, name: str):
        super().__init__(name)
        torch.set_num_threads(1)  # the kernels bring their own threads
        self._configs: dict[type, StageConfig] = {}
        self._diagnostics = self.publisher(messages.DIAGNOSTICS)
        self._error_text, self._error_until, self.error_count = "", 0.0, 0
        self._logged: dict[str, float] = {}
        self.every(1.0, self.publish_diagnostics)

    def every(self, seconds: float, callback: Callable[[], None]) -> Any:
        """A timer of wall time, which also runs while a simulated clock stands still."""
        return self.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

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
                # ROS takes an empty list for one of bytes.
                default = (list(option.default) or Parameter.Type.STRING_ARRAY) if option.type is tuple else option.default
                value = self.declare_parameter(option.name, default, descriptor).value
                values[option.name] = () if value is None else value
            except InvalidParameterTypeException as error:
                kind = {float: "float, with a decimal point", tuple: "list such as [PSM1, PSM2]"}
                kind = kind.get(option.type, option.type.__name__)
                raise ConfigError(f"parameter {option.name} must be a {kind}: {error}") from error
            except Exception as error:  # rclpy has one exception type for each way a value can be wrong
                raise ConfigError(f"parameter {option.name}: {error} ({option.description})") from error
        self._configs[config_class] = _checked(config_class, values)
        if len(self._configs) == 1:
            self.add_on_set_parameters_callback(self._on_set_parameters)
        return self._configs[config_class]

    @functools.cached_property
    def _unknown(self) -> str:
        """What was given at start but is no parameter of this node, in words; ROS itself says nothing about it."""
        known, unknown = self.get_parameters_by_prefix(""), []
        missing = self._parameter_overrides.keys() - known.keys()
        for name in sorted(missing - _meant_for_others() if missing else missing):
            if not name.startswith("qos_overrides."):  # rclpy's own; it declares those that act
                near = difflib.get_close_matches(name, known, 1)
                unknown.append(f"{name} (did you mean {near[0]}?)" if near else name)
        text = f"unknown parameter{'s' * (len(unknown) > 1)} {', '.join(unknown)}" if unknown else ""
        if text:
            self.get_logger().warning(text)
        return text

    def config_changed(self, config: StageConfig) -> None:
        """Called with a whole, valid configuration after one of its parameters was set; override to use it.

        Raises:
            ValueError: If the values cannot be used after all; the parameters then keep their old ones.
        """

    def _on_set_parameters(self, parameters: list) -> SetParametersResult:
        new = {parameter.name: parameter.value for parameter in parameters}
        try:
            changed = []
            for config_class, config in self._configs.items():
                candidate = _checked(config_class, vars(config) | {key: new[key] for key in vars(config) if key in new})
                names = {key for key, value in vars(config).items() if getattr(candidate, key) != value}
                if names & self.read_at_start:
                    fixed = ", ".join(sorted(names & self.read_at_start))
                    raise ConfigError(f"{fixed}: read at start only; restart the node with the new value")
                if names:
                    changed.append(candidate)
            for config in changed:
                self.config_changed(config)
                self._configs[type(config)] = config
        except Exception as error:
            return SetParametersResult(successful=False, reason=sentence("parameters", error))
        return SetParametersResult(successful=True)

    # ----------------------------------------------------------------- topics

    def publisher(self, topic: Topic, depth: int = STREAM_DEPTH) -> Any:
        return self.create_publisher(messages.ros_class(topic.type), topic.name, quality(topic, depth))

    def subscribe(self, topic: Topic, callback: Callable[[Any], None], depth: int = STREAM_DEPTH, reliable: bool = True) -> None:
        """Subscribe with a callback whose errors are reported instead of raised."""

        def guarded(message: Any) -> None:
            with self.guard(topic.name):
                callback(message)

        self.create_subscription(messages.ros_class(topic.type), topic.name, guarded, quality(topic, depth, reliable))

    def service(self, kind: type, name: str, callback: Callable[[Any], tuple[bool, str]]) -> None:
        """Offer a service whose callback takes the request and returns (success, message)."""

        def answer(request: Any, response: Any) -> Any:
            try:
                response.success, response.message = callback(request)
            except Exception as error:
                response.success, response.message = False, sentence(name, error)
                self.report_error(response.message)
            return response

        self.create_service(kind, name, answer)

    def now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    # ------------------------------------------------------------ diagnostics

    def guard(self, where: str) -> "_Guard":
        """Context that reports what its block raises; the node lives on."""
        return _Guard(self, where)

    def report_error(self, text: str) -> None:
        """Show an error on /diagnostics for a while, beginning now; repetitions are only counted."""
        now = time.monotonic()
        text = text if len(text) <= _LONGEST_ERROR else text[:_LONGEST_ERROR] + " …"
        self.error_count += 1
        self._error_text, self._error_until = text, now + _ERROR_SHOWN
        self._logged = {old: when for old, when in self._logged.items() if now - when < _ERROR_SHOWN}
        if text not in self._logged and len(self._logged) < _MOST_LOGGED:
            self._logged[text] = now
            self.get_logger().error(text)
            self.publish_diagnostics()

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, sentence and values of the node's normal state; override."""
        return OK, "running", {}

    def publish_diagnostics(self) -> None:
        try:
            level, text, values = self.status()
        except Exception as error:  # a fault in describing the state must not end the node
            level, text, values = ERROR, sentence("status", error), {}
        if self._unknown and level != ERROR:
            level, text = WARN, f"{text}; {self._unknown}"
        if time.monotonic() < self._error_until:
            level, text = ERROR, self._error_text
        values = values | {"errors": self.error_count}
        try:
            now = self.now_ns()
            if now == 0 and level != ERROR:
                level, text = WARN, "use_sim_time is set but no time came on /clock"
            name = self.get_fully_qualified_name().lstrip("/")
            self._diagnostics.publish(messages.encode_diagnostics(name, level, text, values, now))
        except Exception:
            if self.context.ok():  # otherwise a worker came to its end after the node
                raise


def _meant_for_others() -> set[str]:
    """Parameters of our other nodes that a file gives to all nodes, under /**."""
    ours, general = {option.name for configs in NODE_CONFIGS.values() for config in configs for option in options(config)}, set()
    for flag, path in zip(sys.argv, sys.argv[1:]):
        if flag == "--params-file":
            nodes = yaml.safe_load(Path(path).read_text())  # which ROS has read without complaint
            general |= (nodes.get("/**") or {}).get("ros__parameters", {}).keys()
    return ours & general


class _Guard:
    def __init__(self, node: EndoNode, where: str):
        self._node, self._where = node, where

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, _: Any) -> bool:
        if error is None or not isinstance(error, Exception) or isinstance(error, ExternalShutdownException):
            return False
        if self._node.context.ok():  # what fails because the node is being shut down is no error
            self._node.report_error(sentence(self._where, error))
        return True


class Background:
    """Builds what is wanted in a thread of its own, one thing at a time; only the newest wish counts.

    A wish is known by its key: anything that compares equal only for equal wishes.
    """

    def __init__(self):
        self._executor = ThreadPoolExecutor(1)
        self._key: Any = None
        self._future: Future | None = None

    @property
    def busy(self) -> bool:
        return self._future is not None

    def want(self, key: Any, build: Callable[[], Any]) -> None:
        """Begin to build, unless that was the last wish already; call again and again while busy."""
        if self._future is None and key != self._key:
            self._key, self._future = key, self._executor.submit(build)

    def take(self) -> tuple[Any, Any] | None:
        """Key and result once when a wish has been fulfilled, else None. Raises what the building raised."""
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        return self._key, future.result()

    def stop(self) -> None:
        """Begin nothing more."""
        self._executor.shutdown(wait=False, cancel_futures=True)


def sentence(where: str, error: Exception) -> str:
    """What to tell the user about an error."""
    if isinstance(error, (MessageError, SequenceError, ModelError, ConfigError)):
        return str(error)  # written for the user, with the place in it
    if isinstance(error, (ValueError, OSError)):
        return f"{where}: {error}"
    return f"{where}: unexpected {type(error).__name__}: {error}"


def _checked(config_class: type[Config], values: dict[str, Any]) -> Config:
    """A configuration whose device exists."""
    config = config_class.from_mapping(values)
    if hasattr(config, "device"):
        try:
            pick_device(config.device)
        except ValueError as error:
            raise ConfigError(str(error)) from error
    return config


def quality(topic: Topic, depth: int = STREAM_DEPTH, reliable: bool = True) -> QoSProfile:
    """Quality of service of a topic: reliable; latched topics keep their last message, or the depth asked for, for late joiners."""
    latched = topic.qos == "latched"
    return QoSProfile(
        depth=1 if latched and depth <= STREAM_DEPTH else depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def run(node_class: Callable[[], EndoNode]) -> int:
    """Start ROS, spin a node until it is told to stop, and return the exit status: 2 if it could not start."""
    hear_interrupts()
    end_with_parent()
    prepare_transport()
    try:
        rclpy.init(args=sys.argv)
    except RuntimeError as error:  # arguments that ROS does not understand
        print(f"{node_class.__name__}: {_one_line(error)}", file=sys.stderr)
        return 2
    node, status = None, 0
    try:
        node = node_class()
        executor = NodeExecutor()
        executor.add_node(node)
        gc.freeze()  # looking through all that was imported takes 0.15 s, in which nothing else happens
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ConfigError, NameValidationException) as error:
        print(f"{node_class.__name__}: {_one_line(error)}", file=sys.stderr)
        status = 2
    except Exception:
        if rclpy.ok():  # otherwise an interrupt came while the node was starting, and made that fail
            raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # an impatient second one must not cut short what follows
        with contextlib.suppress(RuntimeError):  # ROS may be shutting itself down at the same moment
            rclpy.try_shutdown()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # ROS has put Python's handler back
        if node is not None:
            node.destroy_node()
    # Python waits for worker threads, and compiled code in them cannot be interrupted: give it a few seconds.
    watchdog = threading.Timer(_END_WITHIN, os._exit, [status])
    watchdog.daemon = True
    watchdog.start()
    return status


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


__all__ = ["ERROR", "OK", "WARN", "Background", "EndoNode", "run", "sentence"]
