"""What is to be learned: each task is a file here, with its script."""

from pathlib import Path

from endo_sim_ros.core.plugins import load_named
from endo_sim_ros.learning.tasks.camera import Camera as Camera
from endo_sim_ros.learning.tasks.clip import Clip
from endo_sim_ros.learning.tasks.dissect import Dissect
from endo_sim_ros.learning.tasks.exposure import Exposure
from endo_sim_ros.learning.tasks.handover import Handover
from endo_sim_ros.learning.tasks.palpation import Palpation
from endo_sim_ros.learning.tasks.retraction import Retraction
from endo_sim_ros.learning.tasks.task import (
    BOUND as BOUND,
    LENGTH as LENGTH,
    Outcome as Outcome,
    Script as Script,
    Task as Task,
    moving as moving,
    norm as norm,
)
from endo_sim_ros.learning.tasks.tension import Tension
from endo_sim_ros.learning.tasks.tracking import Tracking

TASKS: dict[str, type[Task]] = {
    task.name: task for task in (Retraction, Palpation, Tracking, Exposure, Tension, Handover, Camera, Clip, Dissect)
}
"""All tasks by their names."""


def find_task(name: str) -> type[Task]:
    """The class of a task by its name, or by where it is: ``path/to/file.py:Class`` or ``package.module:Class``.

    Raises:
        ValueError: If there is no such task.
    """
    if ":" in name:
        found = load_named(name)
        if not (isinstance(found, type) and issubclass(found, Task)):
            raise ValueError(f"{name} is no task; a task is a subclass of endo_sim_ros.learning.tasks.Task")
        return found
    if name not in TASKS:
        raise ValueError(f"there is no task {name!r}; there are {', '.join(TASKS)}, and your own as file.py:Class")
    return TASKS[name]


def same_task(one: str, other: str) -> bool:
    """Whether two names are those of one task; a file of your own may be named from another folder."""
    return one == other or ":" in one and Path(one).name == Path(other).name
