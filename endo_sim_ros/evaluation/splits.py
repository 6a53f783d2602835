"""Which views of a sequence to train on and which to hold out."""

import dataclasses
import re
from typing import NamedTuple

import numpy as np

from endo_sim_ros.sequences.frames import Frame, SequenceError
from endo_sim_ros.sequences.recordings import lit_area, spread

STEREO = "stereo"
_HELP = "1:49 and the like, two-views, every-12th, all-but-12th and the like, stereo"


class Split(NamedTuple):
    """Indices of views; those held out are right images if ``right``."""

    train: list[int]
    held_out: list[int]
    right: bool = False


def split_views(name: str, count: int) -> Split:
    """Divide ``count`` views.

    Args:
        name: `A:B`: of every A + B views in order the first A train (`1:49` every 50th). `two-views`: the first and the last
            train. `every-12th`: every twelfth trains, from the first on. `all-but-12th`: every twelfth is held out instead.
            `stereo`: every left image trains, every right image is held out.
        count: Number of views of the sequence.

    Raises:
        SequenceError: If there is no such split, or it leaves no view to train on or none to hold out.
    """
    everything, ratio = list(range(count)), re.fullmatch(r"(\d+):(\d+)", name)
    stepped = re.fullmatch(r"(every|all-but)-(\d+)(?:st|nd|rd|th)?", name)
    if name == STEREO:
        return Split(everything, everything, right=True)
    if name == "two-views":
        train = sorted({0, count - 1} & set(everything))
    elif ratio and int(ratio[1]) and int(ratio[2]):
        group = int(ratio[1]) + int(ratio[2])
        train = [i for i in everything if i % group < int(ratio[1])]
    elif stepped and int(stepped[2]) > 1:
        train = [i for i in everything if (i % int(stepped[2]) == 0) == (stepped[1] == "every")]
    else:
        raise SequenceError(f"there is no split {name!r}; give {_HELP}")
    held_out = sorted(set(everything) - set(train))
    if not train or not held_out:
        raise SequenceError(f"split {name} of {count} views leaves {len(train)} to train on and {len(held_out)} to hold out")
    return Split(train, held_out)


def right_views(frames: list[Frame], offset: float = 0.0) -> list[Frame]:
    """The right images of stereo frames as views of their own.

    Args:
        frames: Left views; those without a right image are left out.
        offset: What `disparity_offset` found for them, pixels: by so much the right principal point is farther right.
    """
    pairs = [frame for frame in frames if frame.right is not None]
    if not pairs:
        raise SequenceError("split stereo: the sequence has no right images")
    lit = lit_area(frame.right for frame in spread(pairs, 10))
    views = []
    for frame in pairs:
        K, pose = np.array(frame.camera.K if frame.right_K is None else frame.right_K), frame.camera.pose.copy()
        K[0, 2] += offset
        pose[:3, 3] += frame.baseline * pose[:3, 0]
        camera = dataclasses.replace(frame.camera, K=K, pose=pose)
        views.append(Frame(frame.stamp_ns, frame.right, camera, mask=lit))
    return views
