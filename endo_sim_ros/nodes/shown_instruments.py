"""The instruments of arms as they are published: their tools, where their links are at the time of each state, and what draws them."""

from collections.abc import Collection, Sequence
from typing import Any, Literal

import cv2
import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import LINKS, Capsule, Part, part_links
from endo_sim_ros.instruments.config import DrawingConfig
from endo_sim_ros.instruments.drawing import FIRST_LINK, InstrumentDrawing, PosedInstruments
from endo_sim_ros.instruments.urdf_reader import load_shape
from endo_sim_ros.messages import MessageError
from endo_sim_ros.nodes.background import Background
from endo_sim_ros.nodes.episode_queue import EpisodeQueue
from endo_sim_ros.nodes.pacing import MOST_WAITING

THING = ""
"""In the place of the name of an arm: a thing that is drawn with the instruments."""


class ShownInstruments:
    """Keeps what arms say about their instruments.

    Args:
        arms: Names of the arms, in the order of the labels.
        lockstep: Whether links are wanted for each state, not only the newest.
        thing: Parts and capsules of what is drawn with them, if there is any; its labels follow those of all arms.
    """

    def __init__(self, arms: Sequence[str], lockstep: bool, thing: tuple[list[Part], list[Capsule]] | None = None) -> None:
        self.arms, self._owners = tuple(arms), (*arms, THING)
        self._lockstep = lockstep
        self._types: dict[str, str] = {}
        self.undrawn: dict[str, str] = {}
        """Why arms are not drawn, in a sentence each, by their names."""
        self._tools: dict[str, tuple[list[Part], list[Capsule]]] = {}
        self._thing_links: tuple[str, ...] = ()
        if thing is not None:
            self._tools[THING], self._types[THING], self._thing_links = thing, THING, part_links(thing[0])
        self._links = {arm: EpisodeQueue[np.ndarray](MOST_WAITING if lockstep else 1) for arm in arms}
        self._background = Background()
        self._key: Any = None  # of what is drawn with
        self._drawing: InstrumentDrawing | None = None
        self._failure: Exception | None = None  # why there is none, until that was raised

    def receive_type(self, arm: str, message: Any) -> None:
        """Take the tool of an arm.

        Raises:
            MessageError: If it cannot be loaded. The arm is drawn with the tool that it had; without one it is not drawn, and `undrawn`
                says so.
        """
        name = messages.decode_text(message)
        try:
            tool = load_shape(name)
        except (ConfigError, OSError) as error:
            text = f"{messages.tool_type(arm).name}: {error}; {arm} is "
            if arm in self._tools:
                raise MessageError(f"{text}drawn as before") from error
            self._types[arm], self.undrawn[arm] = name, f"{text}not drawn"
            raise MessageError(self.undrawn[arm]) from error
        self._types[arm], self._tools[arm] = name, tool
        self.undrawn.pop(arm, None)

    def receive_links(self, arm: str, message: Any, world_frame: str) -> bool:
        """Take where the links of an arm are; returns whether they have moved.

        Raises:
            MessageError: If they cannot be used.
        """
        topic = messages.tool_links(arm).name
        messages.check_frame(message, (world_frame,), topic)
        poses, links = messages.decode_poses(message, topic), self._links[arm]
        if len(poses) not in (0, len(LINKS)):
            raise MessageError(f"{topic}: {len(poses)} poses; publish those of {', '.join(LINKS)}, or none while they are not known")
        moved = links.newest is None or not np.array_equal(links.newest, poses)
        links.put(messages.stamp_to_ns(message.header.stamp), poses)
        return moved

    def check_thing(self, poses: np.ndarray) -> None:
        """Raises MessageError if there are not as many poses [n, 4, 4] as the thing has links."""
        if len(poses) != len(self._thing_links):
            text = f"{len(poses)} poses for a thing of {len(self._thing_links)} links; publish its own"
            raise MessageError(f"{messages.THING_POSES.name}: {text}")

    def newest(self) -> dict[str, np.ndarray]:
        """Where the links [5, 4, 4] of each arm are that has said so."""
        return {arm: links.newest for arm, links in self._links.items() if links.newest is not None and len(links.newest)}

    def behind(self, stamp: int, before: int) -> bool:
        """Real time: whether the links of an arm are not those of a state though the arm keeps up with states.

        Args:
            stamp: That of the state, ns.
            before: That of the state before it; an arm whose newest links are older has nobody who publishes them with each state.
        """
        return any(links.newest_stamp is not None and before <= links.newest_stamp != stamp for links in self._links.values())

    def at(self, stamp: int, later: Sequence[int], published: Collection[str]) -> dict[str, np.ndarray] | str:
        """Lockstep: where the links of each arm are at the time of a state, or the name of an arm whose links are awaited.

        Args:
            stamp: That of the state, ns; states are asked for in order, and stamps of an episode come again in the next one.
            later: Stamps of the states after it; where links of these are there, those of this state will not come.
            published: Arms whose links somebody publishes; those whose tool is known are awaited, too.
        """
        found = {}
        for arm, links in self._links.items():
            poses = links.find(stamp, later)
            if poses is None:
                if (arm in published or arm in self._types) and not links.passed(later):
                    return arm
            elif len(poses):
                if arm not in self._types:
                    return arm
                found[arm] = poses
        return found

    def not_repeated(self, stamp: int, published: Collection[str]) -> str:
        """Lockstep: an arm that is awaited and has not said twice where it is at one stamp, as arms do that are reset twice; "" if none.

        Args:
            stamp: That of two states, one after the other, ns.
            published: As `at` has it.
        """
        awaited = (arm for arm in self.arms if arm in published or arm in self._types)
        return next((arm for arm in awaited if self._links[arm].count(stamp) < 2), "")

    def forget(self, stamp: int) -> None:
        """Lockstep: a state was shown, or is not to be; what arms said before and at it is not needed any more."""
        for links in self._links.values():
            links.forget(stamp)

    def forget_repeated(self, stamp: int) -> None:
        """Lockstep: the first of two states with one stamp is not to be shown; what arms said once belongs to the second."""
        for links in self._links.values():
            if links.count(stamp) > 1:
                links.forget(stamp)

    def posed(self, links: dict[str, np.ndarray], config: DrawingConfig, device: str) -> PosedInstruments | None | Literal[False]:
        """What draws the instruments, and the thing, where their links are; None if there are none, False while that is prepared.

        Before any links come that is prepared for all tools that are known, so that the first picture with links shows them.

        Raises what the preparation raised, once; after that there are none.
        """
        names = tuple(owner for owner in self._owners if owner in links and owner in self._tools)
        drawn = names or tuple(owner for owner in self._owners if owner in self._tools)
        tools = [self._tools[arm] for arm in drawn]
        key = tuple((arm, self._types[arm]) for arm in drawn), config, device
        if drawn and key != self._key:
            self._keep_built()
        if drawn and key != self._key:
            self._background.want(
                key, lambda: InstrumentDrawing([parts for parts, _ in tools], config, device, [capsules for _, capsules in tools])
            )
        if not names:
            return None
        if key != self._key:
            return False
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        if self._drawing is None:
            return None
        return self._drawing.at([dict(zip(self._names(owner), links[owner])) for owner in names])

    def _keep_built(self) -> None:
        """Keep what was prepared last, whoever is to be drawn by now: a wish that was fulfilled is not begun again."""
        try:
            built = self._background.take()
        except Exception as error:
            self._key, self._drawing, self._failure = self._background.wish, None, error
            return
        if built is not None:
            self._key, self._drawing = built
            self._failure = None

    def _names(self, owner: str) -> Sequence[str]:
        """Names of the links of an arm, or of the thing."""
        return LINKS if owner != THING else self._thing_links

    def labels(self, instruments: PosedInstruments | None, found: np.ndarray) -> np.ndarray:
        """Labels [H, W] of a picture as they are published: those of an arm and link are the same whoever else is drawn."""
        if instruments is None:
            return found
        table = np.arange(256, dtype=np.uint8)
        names = [owner for owner, _ in self._key[0]]
        for label, (number, link) in enumerate(instruments.drawing.links, FIRST_LINK):
            table[label] = FIRST_LINK + len(LINKS) * self._owners.index(names[number]) + self._names(names[number]).index(link)
        return cv2.LUT(found, table)  # in a third of numpy's time

    def stop(self) -> None:
        """Prepare nothing more."""
        self._background.stop()
