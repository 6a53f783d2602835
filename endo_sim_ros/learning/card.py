"""The README of a dataset of demonstrations, with what Open-H asks to be told: how it was made, what its columns are, and how they agree
in time."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from endo_sim_ros.learning.config import Randomisation
from endo_sim_ros.learning.dataset import COMMAND, IMAGE, JOINT_POSITIONS, SEGMENTATION, STATE, DatasetWriter
from endo_sim_ros.physics.config import MotionConfig

_BY = {"script": "The scripted policy of the task", "person": "A person, who saw the picture of the endoscope in real time or slower,"}
_TOOL = "observation.meta.tool."
_MEANS = {  # of columns, or of all whose names begin so
    STATE: "tip in the frame of the endoscope (x right, y down, z forward), m and xyzw; jaw, rad; force of the tissue on the tool, N",
    JOINT_POSITIONS: "joints of each arm, rad, insertion in m",
    "observation.images.": "picture of the endoscope",
    SEGMENTATION: "what is in each pixel",
    _TOOL: "name of the instrument",
    "observation.endoscope": "joints of the endoscope's arm, rad, insertion in m",
    "observation.environment_state": "state of the task, which knows the goal: nothing for policies that see",
    "action": "relative: how far each tip, or the endoscope, moves, in largest steps of the task; fourth: jaw, or other; -1 to 1",
    COMMAND: "the same as absolute pose of the tip in the world, m and xyzw, and angle of the jaw, rad",
    "command.endoscope": "the same as joints of the endoscope's arm, rad, insertion in m",
    "next.reward": "reward of the action",
    "next.done": "whether it ended the episode",
    "next.success": "whether it solved it",
    "seed": "of the episode",
}
_CARD = """---
license: cc-by-4.0
task_categories:
- robotics
tags:
- LeRobot
- surgical-robotics
- simulation
---

# {task}

{episodes} simulated episodes, {frames} frames at {fps} Hz, of the task *{task}* of endo_sim_ros: {sentence} {by} solved them.

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("local/{name}", root="{name}")
```

## Dataset description

| | |
|---|---|
| trajectories | {episodes}, all solved |
| hours | {hours:.2f} |
| data type | digital simulation |
| domain | surgical robotics |
| skill | {sentence} |
| scenes | {scenes} |
| license | CC BY 4.0 |

Whoever publishes it adds who made it, when, and whom to ask.

## Collection procedure

- **Method.** {by} solved the episodes. Lost ones are left out.
- **Recovery.** {recovery}
- **Diversity.** Each episode has a place and a start of its own. {diversity}

## Robot and sensors

| | |
|---|---|
| robot | {robot} |
| endoscope | {width}×{height} pixels at {fps} Hz, {eyes} |
| force sensor | force of the tissue on the tool, without noise |

## Actions and states

With the observations of a row its action was taken. Units are SI. Rotations are quaternions, x y z w.

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
    varied = [f"{option} {options[option]:g}" for option, value in usual.items() if options[option] != value]
    known = sorted({str(text) for key in writer.features if key.startswith(_TOOL) for text in writer.column(key)})
    rows = ((f"`{key}`", feature["shape"], _meaning(key), ", ".join(feature["names"] or ())) for key, feature in writer.features.items())
    return _CARD.format(
        task=options["task"],
        episodes=writer.episodes,
        frames=writer.frames,
        fps=fps,
        sentence=writer.task,
        by=_BY[options["by"]],
        name=name,
        hours=writer.frames / fps / 3600,
        scenes=", ".join(options["scenes"]),
        recovery=recovery if noise else "No noise was added to actions.",
        diversity=f"What differs beside: {', '.join(varied)}." if varied else "Nothing else differs within a scene.",
        robot=f"simulated PSM of a da Vinci, as the dVRK has it, with {', '.join(known)}" if known else "an ideal tip",
        width=width,
        height=height,
        eyes=f"two eyes, {options['baseline'] * 1000:g} mm apart" if options["eyes"] == 2 else "left eye",
        columns="\n".join("| {} | {} | {} | {} |".format(*row) for row in rows),
    )


def _meaning(key: str) -> str:
    """What a column is; of the indices of LeRobot nothing."""
    return _MEANS.get(key) or next((text for start, text in _MEANS.items() if start.endswith(".") and key.startswith(start)), "")
