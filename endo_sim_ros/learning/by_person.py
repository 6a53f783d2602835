"""Demonstrations by a person, who sees the endoscope's picture in real time and acts with a mouse, keys or other devices.

What a person does goes into the same dataset, by the same code, as what a script does. Whatever is a `Screen`, or a `Device`, can be used.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.learning.demonstrations import Demonstrations, Episode, begin, take
from endo_sim_ros.learning.person_config import PersonConfig
from endo_sim_ros.learning.pictures import IMAGE
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import Task

Word = Literal["again", "drop", "next", "finish"]
"""What a person says: this episode from its beginning; the solved one before is not kept and comes again; another one; no more."""

_WINDOW = 1.0  # s over which it is measured how fast time goes
_SLOW = 0.95  # less of the wanted pace is told
_NARROWEST = 160  # pixels; a page of half of it would show nothing of use


@dataclass
class Wish:
    """What a device asks for in one step."""

    way: np.ndarray = field(default_factory=lambda: np.zeros(3))  # right, up and towards the endoscope, in largest steps, -1 … 1
    turn: float = 0.0  # -1 … 1, the fourth number of a task where it is a speed, or the fifth
    jaw: bool = False  # close it if it is open, and open it if it is closed
    closed: bool | None = None  # close it, or open it; None = as `jaw` says
    hand: int | None = None  # arm of the task that this is for, or its last; None = the one at work
    arm: bool = False  # act with the next arm from now on
    word: Word | None = None
    gone: bool = False  # there is nothing more to hear of the device


class Device(Protocol):
    """What a person acts with."""

    def read(self) -> Wish:
        """What it asks for now; called once a step."""
        ...


@dataclass
class View:
    """What a person is shown."""

    image: np.ndarray  # [H, W, 3], uint8: what the left eye sees
    camera: Camera
    pixel: float  # how many of the largest steps take the tip as far as a pixel, at its depth
    lines: tuple[str, ...]


class Screen(Protocol):
    """What a person looks at."""

    def show(self, view: View) -> None:
        """Show how things are, once a step."""
        ...

    def wait(self, until: float) -> None:
        """Return when the clock, `time.monotonic`, says that it is time for the next step."""
        ...


def demonstrate_by_person(
    demonstrations: Demonstrations, screen: Screen, devices: Sequence[Device], person: PersonConfig = PersonConfig()
) -> int:
    """Let a person solve episodes of a task and write them; returns the number of all in the dataset.

    An episode begins when the person first moves, and goes on in real time. A solved one is kept when the person moves again, or the
    call ends, also where it is interrupted; the next call continues the dataset. One that was lost begins anew.

    Args:
        demonstrations: The dataset, and what its episodes take place in, one at once.
        screen: What the person looks at.
        devices: What the person acts with.
        person: Options of what is seen, and how fast.

    Raises:
        ValueError: If a device asks for what is not a number.
        OSError: If episodes cannot be written, as on a full drive.
    """
    session = _Session(demonstrations, screen, devices, person)
    with demonstrations:
        try:
            session.run()
        finally:
            session.keep()
    return demonstrations.episodes


class _Session:
    """One person and one dataset."""

    def __init__(self, demonstrations: Demonstrations, screen: Screen, devices: Sequence[Device], person: PersonConfig):
        self._demonstrations, self._screen, self._devices, self._wanted = demonstrations, screen, devices, demonstrations.wanted
        self._person = person
        self._gone: list[str] = []  # devices
        self._slow = ""  # how slowly time goes, where it does
        self._shown = [batch.pictures.at_width(person.width) for batch in demonstrations.batches if batch.pictures is not None]
        self._solved: tuple[Episode, int] | None = None  # with its seed: not kept yet
        self._said = ""  # what became of the episode before

    def run(self) -> None:
        """Until as many episodes as wanted are kept, or the person has had enough."""
        seed = self._demonstrations.seed
        while self._demonstrations.episodes < self._wanted:
            episode, word = self._play(seed)
            if word == "finish":
                return
            if word == "drop" and self._solved is not None:
                (_, seed), self._solved, self._said = self._solved, None, "dropped; it comes again"
            elif word == "next":
                seed += 1
            elif episode.solved:
                self._solved, seed = (episode, seed), seed + 1

    def keep(self) -> None:
        """Write the solved episode that has not been kept yet."""
        if self._solved is not None:
            (episode, seed), self._solved = self._solved, None
            self._demonstrations.add({seed: episode})
            self._demonstrations.save()

    def _play(self, seed: int) -> tuple[Episode, Word | None]:
        """One episode, and the word of the person that ended it, if one did; finish, too, where none is missing any more."""
        number = seed % len(self._demonstrations.batches)
        batch = self._demonstrations.batches[number]
        (episode,), seen = begin(batch, [seed])
        period = batch.task.physics().step_duration / self._person.pace
        resting = 0.0 if batch.task.turns else -1.0  # the fourth number, of a speed or an open jaw
        actions, arm = np.zeros((len(batch.task.arms), batch.task.action_size())), 0
        actions[:, 3] = resting
        moving = [0, 1, 2, *([3] if batch.task.turns else [4] if batch.task.twist else [])]
        begun, rested, due = False, False, time.monotonic()
        image, steps, since = self._draw(number), 0, due
        while episode.solved is None:
            self._screen.show(self._view(number, image, arm, actions, begun))
            self._screen.wait(due)
            now = time.monotonic()
            due = max(due, now - period) + period  # what cannot be kept up with is left out
            if begun and now - since > _WINDOW:
                self._slow, steps, since = self._told_pace(steps * period / (now - since)), 0, now
            wishes = self._read()
            words: list[Word] = [wish.word for wish in wishes if wish.word]
            if words:
                self._said = ""
                return episode, words[0]
            arm = (arm + sum(wish.arm for wish in wishes)) % len(actions)
            actions[:, moving] = 0
            for wish in sorted(wishes, key=lambda wish: wish.closed is True):  # of two hands with one arm the one that closes counts
                of = actions[arm if wish.hand is None else min(wish.hand, len(actions) - 1)]
                of[moving] += [*wish.way, wish.turn][: len(moving)]
                if not batch.task.turns and (wish.jaw or wish.closed is not None):
                    of[3] = -of[3] if wish.closed is None else 1.0 if wish.closed else -1.0
            actions = np.clip(actions, -1, 1)
            moves = actions[:, moving].any() or (actions[:, 3] != resting).any()
            if not begun and not (moves and rested):  # what the hand still does of the episode before begins none
                rested |= not moves
                actions[:, 3] = resting
                continue
            if not begun:
                self.keep()
                if self._demonstrations.episodes >= self._wanted:
                    return episode, "finish"
                begun, self._said, steps, since = True, "", 0, time.monotonic()
            action = actions.reshape(1, -1).copy()
            seen, image, steps = take(batch, [episode], seen, action, action), self._draw(number), steps + 1
        self._said = "solved: it is kept when you move, unless you drop it" if episode.solved else self._lost(batch)
        return episode, None

    def _read(self) -> list[Wish]:
        """What all devices ask for.

        Raises:
            ValueError: If it is not a number.
        """
        wishes = [device.read() for device in self._devices]
        for device, wish in zip(self._devices, wishes):
            if not np.isfinite([*wish.way, wish.turn]).all():
                raise ValueError(f"{device} asks for the way {list(wish.way)} and the turn {wish.turn}, which must be finite; mend it")
        self._gone = [
            f"nothing comes from {device}; the mouse and the keys go on" for device, wish in zip(self._devices, wishes) if wish.gone
        ]
        return wishes

    def _told_pace(self, share: float) -> str:
        """What there is to say where time goes at a share of the pace that is wanted."""
        width = self._person.width
        less = f": --page.width {width // 2} draws less" if width >= 2 * _NARROWEST else ""
        return f"time goes at {share * self._person.pace:.2g} of real time{less}" if share < _SLOW else ""

    @staticmethod
    def _lost(batch: TaskBatch) -> str:
        task = batch.task
        why = "too much force" if _force(batch) > task.force_limit else "out of time" if task.steps[0] >= task.horizon else "not the goal"
        return f"lost: {why}; here it is again"

    def _draw(self, number: int) -> np.ndarray:
        """What the left eye sees of a scene [H, W, 3], uint8."""
        return self._shown[number].draw()[IMAGE][0]

    def _view(self, number: int, image: np.ndarray, arm: int, actions: np.ndarray, begun: bool) -> View:
        """What the person is shown of a scene, with an arm at work."""
        batch, pictures = self._demonstrations.batches[number], self._shown[number]
        task, camera = batch.task, pictures.camera.at(pictures.poses[0])
        _, depths = camera.project(task.tips().reshape(-1, 3)[arm : arm + 1])
        pixel = max(float(depths[0]), 0.0) / camera.K[1, 1] / task.step_length
        left = (task.horizon - task.steps[0]) * task.physics().step_duration
        episodes = self._demonstrations.episodes + (self._solved is not None)
        lines = (
            task.sentence,
            f"{episodes} of {self._wanted} episodes",
            f"{left:.1f} s left" if begun else "move to begin" if episodes < self._wanted else "move to end",
            f"{_force(batch):.2f} N of {task.force_limit:g} N",
            *([f"{task.arms[arm]} at work"] if len(actions) > 1 else []),
            *([] if task.turns else _states(task, actions[:, 3])),
            *task.goal_lines(),
            *self._gone,
            *filter(None, (self._slow, self._said)),
        )
        return View(image, camera, pixel, lines)


def _states(task: Task, fourth: np.ndarray) -> list[str]:
    """What the fourth numbers of an action [A] do to jaws and edges; what else they do `Task.goal_lines` says."""
    ones, states = np.ones(len(fourth)), []
    for arm, name in enumerate(task.arms):
        of = f"{name}: " if len(fourth) > 1 else ""
        if task.closes(ones)[arm]:
            states.append(f"{of}jaw {'closed' if task.closes(fourth)[arm] else 'open'}")
        elif task.cuts(ones)[arm]:
            states.append(f"{of}the edge {'cuts' if task.cuts(fourth)[arm] else 'rests'}")
    return states


def _force(batch: TaskBatch) -> float:
    """The greatest force on a tool, N."""
    return float(np.sqrt((batch.task.force.reshape(-1, 3) ** 2).sum(1)).max())
