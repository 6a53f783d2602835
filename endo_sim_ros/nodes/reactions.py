"""What the tissue exerts on tool arms, published once a step or, interpolated, more often."""

import threading
from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.nodes.base import STREAM_DEPTH, EndoNode
from endo_sim_ros.nodes.pacing import MOST_WAITING

_BEHIND = 1.25  # steps from the time of a reaction to when it is published; the quarter is for steps that come late
_TOGETHER = 3  # steps apart: states that are further from each other have nothing between them, as after a pause
_LOOK = 0.1  # seconds after which the time is looked at again: a simulated clock may leap


class ReactionTopics:
    """Publishes the reactions of tool arms.

    With a rate each step brings those since the step before, from one to the other in a straight line, the last with the stamp of the
    step. In lockstep they are published together. In real time each waits until `_BEHIND` steps after its stamp, and a thread
    of its own publishes it: the callbacks of the node are busy with a step for longer than the time between two.

    Args:
        node: The ROS node that the topics belong to.
        arms: Names of the tool arms.
        rate: Reactions a second, Hz; 0 = one with each step, at once.
        lockstep: Whether commands take the steps, not a clock.
    """

    def __init__(self, node: EndoNode, arms: Iterable[str], rate: float, lockstep: bool) -> None:
        self._node, self._rate = node, rate
        depth = MOST_WAITING if rate and lockstep else STREAM_DEPTH
        self._publishers = {arm: node.publisher(messages.tool_reaction(arm), depth, alone=True) for arm in arms}
        self._last: tuple[int, Mapping[str, np.ndarray]] = 0, {}
        self._waiting: deque[tuple[int, dict[str, np.ndarray]]] = deque()
        self._behind = 0.0  # s
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._play, daemon=True) if rate and not lockstep else None
        if self._thread is not None:
            self._thread.start()

    def publish(self, reactions: Mapping[str, np.ndarray], stamp: int, step_duration: float) -> None:
        """Publish the reactions of a step, and those between the step before and this one.

        Args:
            reactions: Force and torque [6] on each arm whose pose is known, N and N·m, in the axes of its tip.
            stamp: Time of the state, ns.
            step_duration: Of the simulation, s.
        """
        (before, old), self._last = self._last, (stamp, reactions)
        apart = (stamp - before) * 1e-9
        goes_on = self._rate > 0 and 0 < apart <= _TOGETHER * step_duration
        count = max(round(apart * self._rate), 1) if goes_on else 1
        series = []
        for k in range(1, count + 1):
            share = k / count
            values = {arm: (1 - share) * old.get(arm, 0 * now) + share * now for arm, now in reactions.items()}
            series.append((before + (stamp - before) * k // count if k < count else stamp, values))
        if self._thread is None:
            for each in series:
                self._send(*each)
            return
        with self._changed:
            if stamp <= before:  # the clock went back
                self._waiting.clear()
            self._waiting += series
            self._behind = _BEHIND * step_duration
            self._changed.notify()

    def stop(self) -> None:
        """Publish nothing more."""
        if self._thread is not None:
            with self._changed:
                thread, self._thread = self._thread, None
                self._changed.notify()
            thread.join()

    def _send(self, stamp: int, reactions: dict[str, np.ndarray]) -> None:
        for arm, values in reactions.items():
            self._publishers[arm].publish(messages.encode_wrench(values[:3], values[3:], stamp, arm))

    def _play(self) -> None:
        """Publish what waits, each when its time has come."""
        while (due := self._next()) is not None:
            with self._node.guard("reactions"):
                self._send(*due)

    def _next(self) -> tuple[int, dict[str, np.ndarray]] | None:
        """The next reactions, with their stamp, as soon as they are due; None when there will be no more."""
        with self._changed:
            while self._thread is not None:
                early = (self._waiting[0][0] - self._node.now_ns()) * 1e-9 + self._behind if self._waiting else _LOOK
                if early <= 0:
                    return self._waiting.popleft()
                self._changed.wait(min(early, _LOOK))
        return None
