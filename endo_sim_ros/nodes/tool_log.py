"""What arms said of their tools, kept for as long as it is wanted."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.learning.streams import Stream, pose_row, to_world, wrench_row
from endo_sim_ros.messages import Topic
from endo_sim_ros.nodes.base import EndoNode

_JUMP = 500_000_000  # ns by which stamps step back where time begins anew; messages that are merely late step back by less


class ToolLog:
    """Poses, jaws, reactions and wrenches of arms by the time in their headers.

    Args:
        node: That hears them.
        arms: Names of the arms.
        frames: Returns the poses [4, 4] of known frames in the world, by name.
        depth: Messages that may wait while the node is busy.
    """

    def __init__(self, node: EndoNode, arms: tuple[str, ...], frames: Callable[[], Mapping[str, np.ndarray]], depth: int):
        self._arms = arms
        self._rows: dict[Topic, list[tuple[int, Any]]] = defaultdict(list)
        self.begun_anew = False
        """Whether time has stepped back; what was said before is forgotten. Whoever looks sets it back."""
        for arm in arms:
            tip = lambda m, topic, arm=arm: pose_row(messages.decode_tip(m, frames(), arm, topic))
            self._hear(node, messages.tool_pose(arm), tip, depth)
            for make in (messages.tool_jaw, messages.tool_jaw_state):
                self._hear(node, make(arm), lambda m, topic: [messages.decode_jaw(m, topic)], depth)
            for make in (messages.tool_wrench, messages.tool_reaction):
                self._hear(node, make(arm), lambda m, topic, arm=arm: wrench_row(m, topic, arm, frames()), depth)

    def _hear(self, node: EndoNode, topic: Topic, decode: Callable[[Any, str], Any], depth: int) -> None:
        def keep(message: Any) -> None:
            stamp, rows = messages.stamp_to_ns(message.header.stamp), self._rows[topic]
            if not stamp:  # marks an invalid message
                return
            if rows and stamp < rows[-1][0] - _JUMP:
                self.clear()
                self.begun_anew = True
            self._rows[topic].append((stamp, decode(message, topic.name)))

        node.subscribe(topic, keep, depth)

    def clear(self) -> None:
        """Forget everything."""
        self._rows.clear()

    def forget_before(self, stamp_ns: int) -> None:
        """Forget what is older, but the newest of it: a jaw stays as it is."""
        for rows in self._rows.values():
            old = sum(stamp < stamp_ns for stamp, _ in rows)
            del rows[: max(old - 1, 0)]

    def streams(self) -> dict[Topic, Stream]:
        """What was said, wrenches in the axes of the world, as `learning.streams.read_streams` returns it."""
        found = {}
        for topic, rows in self._rows.items():
            if rows:
                pairs = sorted(rows, key=lambda pair: pair[0])
                found[topic] = Stream(np.array([stamp for stamp, _ in pairs], np.int64), np.array([row for _, row in pairs], np.float64))
        for arm in self._arms:
            tips = found.get(messages.tool_pose(arm))
            for topic in (messages.tool_wrench(arm), messages.tool_reaction(arm)):
                if topic in found:
                    if tips is None:
                        del found[topic]
                    else:
                        found[topic] = to_world(found[topic], tips)
        return found
