"""The README of a dataset of demonstrations, with what Open-H asks to be told: how it was made, what its columns are, and how they agree
in time."""

import re
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from endo_sim_ros.instruments.drawing import FIRST_LINK
from endo_sim_ros.learning.config import Randomisation
from endo_sim_ros.learning.dataset import CAMERA_POSE, COMMAND, IMAGE, IMAGE_RIGHT, JOINT_POSITIONS, SEGMENTATION, STATE, DatasetWriter
from endo_sim_ros.learning.tasks import BOUND, FORCE, LENGTH, Task, find_task
from endo_sim_ros.physics.config import MotionConfig

_BY = {"script": "The scripted policy of the task", "person": "A person, who saw the picture of the endoscope in real time or slower,"}
_TOOL = "observation.meta.tool."
_LINKS = "shaft, wrist, hook (of a tool without jaws), left jaw, right jaw"
_MEANS = {  # of columns, or of all whose names begin so
    STATE: "tip in the frame of the endoscope (x right, y down, z forward), m and xyzw; jaw, rad; force of the tissue on the tool, N",
    JOINT_POSITIONS: "joints of each arm, rad, insertion in m",
    IMAGE: "picture of the left eye of the endoscope",
    IMAGE_RIGHT: "picture of its right eye",
    SEGMENTATION: "what is in each pixel of the left eye's picture: {labels}",
    _TOOL: "name of the instrument",
    CAMERA_POSE: "pose of the left eye in the world (x right, y down, z forward), m and xyzw",
    "observation.endoscope": "joints of the endoscope's arm, rad, insertion in m",
    "observation.environment_state": "state of the task, which knows the goal: nothing for policies that see. In units of the task, not "
    "SI: lengths in {length:g} m or parts of what is wanted, in the episode's frame (see action), forces in {force:g} N; clipped to "
    "±{bound:g}",
    "action": "relative, -1 to 1: how far each tip moves along x, y and z of the episode's frame (to the right and up in the picture, and "
    "towards the endoscope), in steps of {step:g} mm; fourth: {fourth}{twist}",
    COMMAND: "the same as absolute pose of the tip in the world, m and xyzw, and angle of the jaw, rad",
    "command.endoscope": "the same as joints of the endoscope's arm, rad, insertion in m",
    "next.reward": "reward of the action",
    "next.done": "whether it ended the episode",
    "next.success": "whether it solved it",
    "seed": "of the episode",
}
_OF_ENDOSCOPE = {  # in tasks whose actions move it
    "action": "relative, -1 to 1: how far the endoscope on the ECM turns to the right and up as the picture shows these, in steps of "
    "{turn:g} rad, slides in, of {step:g} mm, and rolls, of {roll:g} rad",
    COMMAND: "the same as absolute pose of the endoscope on the ECM in the world (x right, y down, z forward), m and xyzw",
}
_LOADED = """```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # of lerobot {version}

dataset = LeRobotDataset("local/{name}", root="{name}")
```"""
_LOADS = re.compile(r"```python\n(?:(?!```).)*?LeRobotDataset\((?:(?!```).)*?```", re.DOTALL)
_CARD = """---
license: {license}
task_categories:
- robotics
tags:
- LeRobot
- surgical-robotics
- simulation
---

# {task}

{episodes} simulated episodes, {frames} frames at {fps} Hz, of the task *{task}* of endo_sim_ros: {sentence} {by} solved them.

{loaded}

## Dataset description

| | |
|---|---|
| trajectories | {episodes}, all solved |
| hours | {hours:.2f} |
| data type | digital simulation |
| domain | surgical robotics |
| skill | {sentence} |
| scenes | {scenes} |
| license | {license} |

Whoever publishes it adds who made it, when, and whom to ask.

## Collection procedure

- **Method.** {by} solved the episodes. Lost ones are left out.
- **Recovery.** {recovery}
- **Diversity.** By the seed of an episode the task draws what it leaves to chance, such as places, starts and goals. {diversity}

## Robot and sensors

| | |
|---|---|
| robot | {robot} |
| endoscope | {width}×{height} pixels at {fps} Hz, {eyes} |
| force sensor | force of the tissue on the tool, without noise |

## Actions and states

With the observations of a row its action was taken. Units are SI where nothing else is told. Rotations are quaternions, x y z w.

| column | shape | content | names |
|---|---|---|---|
{columns}

## Synchronization

All of a row is of the same state of the simulation, pictures too. Row k of an episode is at k/{fps} s.
"""


def card(name: str, options: Mapping[str, Any], fps: int, writer: DatasetWriter) -> str:
    """Text of the README.

    Args:
        name: Of the folder.
        options: What the episodes depend on, as meta/demonstrations.json has it.
        fps: Rows per second.
        writer: What was written.
    """
    height, width, _ = writer.features[IMAGE]["shape"]
    noise = options["noise"]
    recovery = f"Noise of deviation {noise:g} was added to actions before they acted; what is written is the action without it."
    usual = {**asdict(Randomisation()), **asdict(MotionConfig())}
    varied = [f"{option} {options[option]:g}" for option, value in usual.items() if options.get(option, value) != value]
    varied += [f"the motion of {options['motion_file']}"] if "motion_file" in options else []
    known = sorted({str(text) for key in writer.features if key.startswith(_TOOL) for text in writer.column(key)})
    task = find_task(options["task"])
    turns, told = task.turns, _told(task, options["instrument"])
    means = _MEANS | (_OF_ENDOSCOPE if turns else {})
    rows = (
        (f"`{key}`", feature["shape"], _meaning(key, means).format(**told), ", ".join(feature["names"] or ()))
        for key, feature in writer.features.items()
    )
    robot = f"simulated PSM of a da Vinci, as the dVRK has it, with {', '.join(known)}" if known else "an ideal tip"
    return _CARD.format(
        task=options["task"],
        episodes=writer.episodes,
        frames=writer.frames,
        fps=fps,
        sentence=writer.task,
        by=_BY[options["by"]],
        license=options["license"],
        loaded=_LOADED.format(name=name, version="0.4 or newer"),
        hours=writer.frames / fps / 3600,
        scenes=", ".join(options["scenes"]),
        recovery=recovery if noise else "No noise was added to actions.",
        diversity=f"What differs beside: {', '.join(varied)}." if varied else "Beside that nothing differs within a scene.",
        robot=("simulated ECM of a da Vinci, as the dVRK has it, which the actions move; beside it a " if turns else "") + robot,
        width=width,
        height=height,
        eyes=f"two eyes, {options['baseline'] * 1000:g} mm apart" if options["eyes"] == 2 else "left eye",
        columns="\n".join("| {} | {} | {} | {} |".format(*row) for row in rows),
    )


def card_of_v21(text: str, name: str) -> str:
    """Text of the README of a copy in layout v2.1 in a folder of this name: how it is loaded is another."""
    return _LOADS.sub(lambda _: _LOADED.format(name=name, version="0.3"), text, count=1)


def _meaning(key: str, means: Mapping[str, str]) -> str:
    """What a column is; of the indices of LeRobot nothing."""
    return means.get(key) or next((text for start, text in means.items() if start.endswith(".") and key.startswith(start)), "")


def _told(task: type[Task], instrument: bool) -> dict[str, Any]:
    """What texts about columns say of a task, whose pictures show instruments or not."""
    links = len(_LINKS.split(", "))
    seen = ["0 nothing", "1 tissue"]
    labels = []
    for number, arm in enumerate(task.arms):
        first = FIRST_LINK + links * number
        labels.append(f"{first} to {first + links - 1} {_LINKS} of {arm}")
    thing = task.thing()
    names = dict.fromkeys(part.link for part in thing[0]) if thing else ()
    labels += [f"{label} {name.replace('_', ' ')}" for label, name in enumerate(names, FIRST_LINK + links * len(task.arms))]
    twist = f"; fifth: turns it counter-clockwise in the picture, in steps of {task.twist:g} rad" if task.twist else ""
    own = {name: getattr(task, name) for name in ("turn", "roll") if task.turns}
    return {
        "labels": ", ".join(seen + labels * instrument),
        "length": LENGTH,
        "force": FORCE,
        "bound": BOUND,
        "step": 1e3 * task.step_length,
        "fourth": task.fourth_does or "above 0 the jaw is closed",
        "twist": twist,
        **own,
    }
