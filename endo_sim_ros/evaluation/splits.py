"""Which views of a sequence to train on and which to hold out."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.masks import black_level, lit_area, lit_now
from endo_sim_ros.sequences.recording import spread

STEREO, TWO_VIEWS = "stereo", "two-views"
_RATIO = r"([1-9]\d*):([1-9]\d*)"
_STEPPED = r"(every|all-but)-([2-9]|[1-9]\d+)(?:st|nd|rd|th)?"
_HELP = "1:49 and the like, two-views, every-12th, all-but-12th and the like, stereo"


class Split(NamedTuple):
    """Indices of views; those held out are right images if ``right``."""

    train: list[int]
    held_out: list[int]
    right: bool = False


def check_split(name: str) -> None:
    """Raise SequenceError unless there is such a split."""
    if not any(re.fullmatch(pattern, name) for pattern in (_RATIO, _STEPPED, TWO_VIEWS, STEREO)):
        raise SequenceError(f"there is no split {name!r}; give {_HELP}")


def split_views(name: str, count: int, most: int | None = None) -> Split:
    """Divide ``count`` views.

    Args:
        name: `A:B`: of every A + B views in order the first A train (`1:49` every 50th). `two-views`: the first and the last
            train. `every-12th`: every twelfth trains, from the first on. `all-but-12th`: every twelfth is held out instead.
            `stereo`: every left image trains, every right image is held out.
        count: Number of views of the sequence.
        most: Views to hold out at most, evenly spread; the others count nowhere.

    Raises:
        SequenceError: If there is no such split, or it leaves no view to train on or none to hold out.
    """
    check_split(name)
    everything = list(range(count))
    fewer = lambda views: views if most is None else spread(views, most)
    if name == STEREO:
        return Split(everything, fewer(everything), right=True)
    if name == TWO_VIEWS:
        trains = lambda i: i in (0, count - 1)
    elif ratio := re.fullmatch(_RATIO, name):
        share, group = int(ratio[1]), int(ratio[1]) + int(ratio[2])
        trains = lambda i: i % group < share
    else:
        kind, step = _stepped(name)
        trains = lambda i: (i % int(step) == 0) == (kind == "every")
    train = [i for i in everything if trains(i)]
    held_out = sorted(set(everything) - set(train))
    if not train or not held_out:
        raise SequenceError(f"split {name} of {counted(count, 'view')} leaves {len(train)} to train on and {len(held_out)} to hold out")
    return Split(train, fewer(held_out))


def explain_split(name: str) -> str:
    """A sentence for readers of results."""
    if name == STEREO:
        return "All left images train, all right images are held out."
    if name == TWO_VIEWS:
        return "The first and the last view train, all others are held out."
    if ratio := re.fullmatch(_RATIO, name):
        share, rest = int(ratio[1]), int(ratio[2])
        first = f"first {share} train" if share > 1 else "first one trains"
        return f"Of each {share + rest} views in order the {first}, the others are held out."
    kind, step = _stepped(name)
    if kind == "every":
        return f"One view in {step} trains, beginning with the first; the others are held out."
    return f"One view in {step} is held out, beginning with the first; the others train."


def _stepped(name: str) -> tuple[str, str]:
    """Kind (`every` or `all-but`) and step of a split that goes by every n-th view."""
    match = re.fullmatch(_STEPPED, name)
    assert match is not None  # the only other kind that check_split lets pass
    return match[1], match[2]


def right_views(frames: Sequence[Frame]) -> list[Frame]:
    """The right images of stereo frames as views of their own; a frame without one is left out.

    Raises:
        SequenceError: If there are none.
    """
    pairs = [(frame, frame.right) for frame in frames if frame.right is not None]
    if not pairs:
        raise SequenceError("split stereo: the sequence has no right images")
    sample = [right for _, right in spread(pairs, 10)]
    lit = lit_area(sample, black := black_level(sample))
    return [Frame(frame.stamp_ns, right, frame.right_camera, mask=lit_now(lit, right, black)) for frame, right in pairs]
