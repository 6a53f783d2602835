"""What all ROS nodes share: topics, services, diagnostics, guarded callbacks, start and stop."""

import contextlib
import gc
import json
import os
import re
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from rclpy.utilities import ok, remove_ros_args, try_shutdown

from endo_sim_ros import messages
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.plugins import told_where
from endo_sim_ros.messages import ERROR, OK, SET, STATE, WARN, ClientState, Topic
from endo_sim_ros.nodes.configs import NODE_CONFIGS
from endo_sim_ros.nodes.errors import sentence
from endo_sim_ros.nodes.listeners import delivered
from endo_sim_ros.nodes.parameter_file import parameter_file
from endo_sim_ros.nodes.parameters import ConfiguredNode
from endo_sim_ros.nodes.process import end_with_parent, keep_memory
from endo_sim_ros.nodes.rclpy_private import spin
from endo_sim_ros.nodes.transport import prepare_transport

_NUMBER = re.compile(r"\d[\d.]*(e[-+]?\d+)?")
_ERROR_SHOWN = 5.0  # seconds that an error stays on /diagnostics, and that its repetitions are not logged
MOST_LOGGED = 10  # different errors logged in that time: one whose text differs at 500 Hz must not flood the log
_LONGEST_ERROR = 1000  # characters; a sentence may quote what came, and that may be megabytes
_LAST_WORD_WITHIN = 2.0  # seconds that the last status has to arrive before its publisher is gone
_END_WITHIN = 3.0  # seconds that worker threads have to end before the process ends without them
# A killed node stays known for 20 seconds. Whoever starts in its place must not take it for one that lives.
_DISCOVERED = 5.0  # seconds after the start in which those are found that were there before
_FORGOTTEN = 25.0  # seconds after which one of those that is still there is alive
STREAM_DEPTH = 20  # messages that wait for a slow subscriber: 0.7 s of a camera at 30 Hz


class EndoNode(ConfiguredNode):
    """A ROS node that survives errors in its callbacks: each becomes one sentence on /diagnostics."""

    failed = False
    """Whether work that has an end could not be done: the process then ends with status 1."""

    def __init__(self, name: str, context: Context | None = None) -> None:
        super().__init__(name, context)
        if torch := sys.modules.get("torch"):  # not imported by the nodes that start sooner without it
            torch.set_num_threads(1)  # the kernels bring their own threads
        self._diagnostics = self.publisher(messages.DIAGNOSTICS)
        self._notices = dict[int, tuple[str, float]]()  # by level: what is shown for a while, and until when
        self.error_count = 0
        self.logged: dict[str, float] = {}
        self._started = time.monotonic()
        self._alone: list[Publisher] = []  # publishers of topics that nobody else may publish
        self._mixed: dict[str, float] = {}  # those of their topics that others publish, and since when, as far as is known
        self._mixed_text = ""
        self.every(1.0, self.publish_diagnostics)

    def every(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """A timer of wall time, which also runs while a simulated clock stands still."""
        return self.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # ----------------------------------------------------------------- topics

    def publisher(self, topic: Topic, depth: int = STREAM_DEPTH, alone: bool = False) -> Publisher:
        """A publisher of a topic.

        Args:
            topic: The topic.
            depth: Messages that are kept for subscribers that are slow.
            alone: Warn on /diagnostics when anybody else publishes it: subscribers would take the one for the other.

        Raises:
            MessageError: If the type of the topic is not installed.
        """
        publisher = self.create_publisher(messages.ros_class(topic.type), topic.name, quality(topic, depth))
        if alone:
            self._alone.append(publisher)
        return publisher

    def subscribe(self, topic: Topic, callback: Callable[[Any], None], depth: int = STREAM_DEPTH, reliable: bool = True) -> None:
        """Subscribe with a callback whose errors are reported, with the name of the topic, instead of raised.

        Args:
            topic: The topic.
            callback: Called with each message.
            depth: Messages that wait while a callback runs; the oldest is dropped.
            reliable: Have lost messages repeated.

        Raises:
            MessageError: If the type of the topic is not installed.
        """

        def guarded(message: Any) -> None:
            with self.guard(topic.name):
                callback(message)

        self.create_subscription(messages.ros_class(topic.type), topic.name, guarded, quality(topic, depth, reliable))

    def service(self, kind: type, name: str, callback: Callable[[Any], tuple[bool, str]]) -> None:
        """Offer a service whose callback takes the request and returns (success, message); its errors are answers, too."""

        def answer(request: Any, response: Any) -> Any:
            try:
                response.success, response.message = callback(request)
            except Exception as error:
                response.success, response.message = False, sentence(name, error)
                self.report_error(response.message)
            return response

        self.create_service(kind, name, answer)

    def now_ns(self) -> int:
        """Time of the clock of the node, ns: that of /clock with use_sim_time, 0 until one arrives."""
        return self.get_clock().now().nanoseconds

    # ------------------------------------------------------------ diagnostics

    @contextlib.contextmanager
    def guard(self, where: str) -> Iterator[None]:
        """Context that reports what its block raises, and where if the error does not say so; the node lives on."""
        try:
            with told_where():
                yield
        except ExternalShutdownException:
            raise
        except Exception as error:
            if self.context.ok():  # what fails because the node is being shut down is no error
                self.report_error(sentence(where, error))

    def report_error(self, text: str) -> None:
        """Show an error on /diagnostics for a while, beginning now; repetitions are only counted."""
        self.error_count += 1
        self._show_notice(ERROR, text)

    def report_warning(self, text: str) -> None:
        """Show for a while what may well have been wanted, but not be missed. It is no error, and hides none."""
        self._show_notice(WARN, text)

    def _show_notice(self, level: int, text: str) -> None:
        now = time.monotonic()
        text = text if len(text) <= _LONGEST_ERROR else text[:_LONGEST_ERROR] + " …"
        self._notices[level] = text, now + _ERROR_SHOWN
        self.logged = {old: when for old, when in self.logged.items() if now - when < _ERROR_SHOWN}
        said = _NUMBER.sub("0", text)  # a force that grows makes no other error
        if said not in self.logged and len(self.logged) < MOST_LOGGED:
            self.logged[said] = now
            if level == ERROR:  # rclpy keeps the severity of each line of code
                self.get_logger().error(text)
            else:
                self.get_logger().warning(text)
            self.publish_diagnostics()

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values of the node; override. The value of the key `state` is one of a `NodeState`."""
        return OK, "running", {STATE: ClientState.RUNNING}

    def publish_diagnostics(self) -> None:
        """Publish the status of the node now, or the newest error for a while; also called once a second."""
        try:
            level, text, values = self.status()
            if level != ERROR and (mixed := self._mixing()):
                level, text = WARN, f"{text}; {mixed}"
        except Exception as error:  # a fault in describing the state must not end the node
            level, text, values = ERROR, sentence("status", error), {}
        if self._unknown and level != ERROR:
            level, text = WARN, f"{text}; {self._unknown}"
        now = time.monotonic()
        notices = [(kind, said) for kind, (said, until) in sorted(self._notices.items(), reverse=True) if kind >= level and now < until]
        if notices:
            level, text = notices[0][0], "; ".join(said for _, said in notices)
        values = values | {"errors": self.error_count}
        if self._set_since:
            values[SET] = json.dumps(self._set_since)
        try:
            now = self.now_ns()
            if now == 0 and level != ERROR:
                level, text = WARN, "use_sim_time is set but no time came on /clock"
            name = self.get_fully_qualified_name().lstrip("/")
            self._diagnostics.publish(messages.encode_diagnostics(name, level, text, values, now))
        except Exception:
            if self.context.ok():  # otherwise a worker came to its end after the node
                raise

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Also tells at once what was set: the node may crash of it."""
        result = super()._on_set(parameters)
        if result.successful and self._set_since:
            self.publish_diagnostics()
        return result

    def finish(self, done: str) -> None:
        """Say what was done, on /diagnostics and in the log, and end the process: for a node whose work has an end."""
        self.publish_diagnostics()
        delivered(self._diagnostics, _LAST_WORD_WITHIN)
        self.get_logger().info(f"finished: {done}")
        try_shutdown(context=self.context)

    def _mixing(self) -> str:
        """Which topics of this node others publish as well, in words."""
        now, found = time.monotonic(), [publisher.topic_name for publisher in self._alone]
        found = [topic for topic in found if self.count_publishers(topic) > 1]
        self._mixed = {topic: self._mixed.get(topic, now) for topic in found}
        late = now - self._started > _FORGOTTEN
        topics = [topic for topic, since in self._mixed.items() if late or since - self._started > _DISCOVERED]
        if not topics:
            self._mixed_text = ""
        elif not self._mixed_text:
            infos = self.get_publishers_info_by_topic(topics[0])
            names = Counter(publisher_name(info.node_namespace, info.node_name) for info in infos)
            who = ", ".join(f"{name} {count} times" if count > 1 else name for name, count in names.items())
            more = f" and {len(topics) - 1} more topics" if len(topics) > 1 else ""
            self._mixed_text = (
                f"more than one node publishes {topics[0]}{more} ({who}), and their messages mix; "
                "end one of them, or give each graph a namespace or a ROS_DOMAIN_ID of its own"
            )
            self.get_logger().warning(self._mixed_text)
        return self._mixed_text


def publisher_name(namespace: str, name: str) -> str:
    """Who publishes a topic, in words; DDS may know of a publisher before it knows of its node."""
    unknown = "_NODE_NAME_UNKNOWN_"  # rmw_dds_common
    return f"{namespace.rstrip('/')}/{name}" if name != unknown else "a node that does not tell its name"


def quality(topic: Topic, depth: int = STREAM_DEPTH, reliable: bool = True) -> QoSProfile:
    """Quality of service of a topic: reliable; latched topics keep their last message, or the depth asked for, for late joiners."""
    latched = topic.qos == "latched"
    return QoSProfile(
        depth=1 if latched and depth <= STREAM_DEPTH else depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


@contextlib.contextmanager
def shutdown_interrupts() -> Iterator[None]:
    """Context in which the end of ROS is Ctrl-C: what its block raises once ROS is shut down becomes KeyboardInterrupt.

    ROS hears a signal in a thread of its own. Whatever uses it at that moment fails, with an error that depends on what it was.
    """
    try:
        yield
    except Exception as error:
        if ok():
            raise
        raise KeyboardInterrupt from error


def run(node_class: Callable[[], EndoNode]) -> int:
    """Start ROS, spin a node until it is told to stop, and return the exit status: 2 if it could not start.

    With --help it only tells the parameters.
    """
    spinning = False
    name, words = Path(sys.argv[0]).stem, []
    with contextlib.suppress(RuntimeError):  # arguments that ROS does not understand are told below
        words = remove_ros_args(sys.argv)[1:]
    if {"-h", "--help"} & {*words}:
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # help that `head` or `less` has read enough of ends without an error
        print(_help(name, node_class))
        return 0
    if words:
        where = "parameters are given as --ros-args -p NAME:=VALUE, and --help lists them"
        print(f"{name}: unknown argument {' '.join(words)}; {where}", file=sys.stderr)
        return 2

    def on_interrupt(*_: Any) -> None:
        if not spinning:
            raise KeyboardInterrupt  # in a callback rclpy would log it as an error of that; it ends the spinning by itself

    signal.signal(signal.SIGINT, on_interrupt)
    end_with_parent()
    keep_memory()
    prepare_transport()
    try:
        rclpy.init(args=sys.argv)
    except RuntimeError as error:  # arguments that ROS does not understand
        print(f"{node_class.__name__}: {_one_line(error)}", file=sys.stderr)
        return 2
    node, status = None, 0
    try:
        with shutdown_interrupts():
            node = node_class()
            node.get_logger().info(f"ready; {node.status()[1]}")
            gc.freeze()  # looking through all that was imported takes 0.15 s, in which nothing else happens
            gc.enable()
            spinning = True
            spin(node)
    except KeyboardInterrupt:
        pass
    except (ConfigError, NameValidationException) as error:
        print(f"{node_class.__name__}: {_one_line(error)}", file=sys.stderr)
        status = 2
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # an impatient second one must not cut short what follows
        with contextlib.suppress(RuntimeError):  # ROS may be shutting itself down at the same moment
            try_shutdown()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # ROS has put Python's handler back
        if node is not None:
            status = status or int(node.failed)
            node.destroy_node()
    # Python waits for worker threads, and compiled code in them cannot be interrupted: give it a few seconds.
    watchdog = threading.Timer(_END_WITHIN, os._exit, [status])
    watchdog.daemon = True
    watchdog.start()
    return status


def _help(name: str, node_class: Callable[[], EndoNode]) -> str:
    """What --help prints: what a node does, and its parameters as a file for --params-file."""
    node = name if name in NODE_CONFIGS else name.removesuffix("_node")
    usage = f"usage: ros2 run endo_sim_ros {name} [--ros-args [-p NAME:=VALUE]... [--params-file FILE]... [-r FROM:=TO]...]"
    return f"{usage}\n\n{node_class.__doc__}\n\nIts parameters with their defaults, as a parameter file:\n\n{parameter_file((node,))}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
