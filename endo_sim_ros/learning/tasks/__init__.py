"""What is to be learned: each task is a file here, with its script."""

import logging
from pathlib import Path

import numpy as np

from endo_sim_ros.core.plugins import digest_of, load_named
from endo_sim_ros.learning.tasks.camera import Camera as Camera
from endo_sim_ros.learning.tasks.clip import Clip
from endo_sim_ros.learning.tasks.dissect import Dissect
from endo_sim_ros.learning.tasks.exposure import Exposure
from endo_sim_ros.learning.tasks.handover import Handover
from endo_sim_ros.learning.tasks.palpation import Palpation
from endo_sim_ros.learning.tasks.retraction import Retraction
from endo_sim_ros.learning.tasks.task import (
    BOUND as BOUND,
    FORCE as FORCE,
    LENGTH as LENGTH,
    Outcome as Outcome,
    Script as Script,
    Task as Task,
    moving as moving,
    norm as norm,
)
from endo_sim_ros.learning.tasks.tension import Tension
from endo_sim_ros.learning.tasks.tracking import Tracking
from endo_sim_ros.physics import ControlNodes

_logger = logging.getLogger(__name__)

_HAS = "name", "sentence", "observation_names", "horizon", "force_limit", "low", "high"

TASKS: dict[str, type[Task]] = {
    task.name: task for task in (Retraction, Palpation, Tracking, Exposure, Tension, Handover, Camera, Clip, Dissect)
}
"""All tasks by their names."""


def find_task(name: str) -> type[Task]:
    """The class of a task by its name, or by where it is: ``path/to/file.py:Class`` or ``package.module:Class``.

    Raises:
        ValueError: If there is no such task, or a class has not what each task has.
    """
    if ":" in name:
        found = load_named(name)
        if not (isinstance(found, type) and issubclass(found, Task)):
            raise ValueError(f"{name} is no task; a task is a subclass of endo_sim_ros.learning.tasks.Task")
        _check(name, found)
        return found
    if name not in TASKS:
        raise ValueError(f"there is no task {name!r}; there are {', '.join(TASKS)}, and your own as file.py:Class")
    return TASKS[name]


def set_up(task: type[Task], nodes: ControlNodes, endoscope: np.ndarray, count: int = 1) -> Task:
    """A task, made of what `Task` takes.

    Raises:
        ValueError: As `Task` does.
        RuntimeError: If a class of a user's own does not call what sets up each task.
    """
    made = task(nodes, endoscope, count)
    if not hasattr(made, "places"):
        raise RuntimeError(f"{task.__name__}: its __init__ must call that of Task: super().__init__(nodes, endoscope, count)")
    return made


def _check(name: str, task: type[Task]) -> None:
    """Find out whether a class has what each task has; raises ValueError if not."""
    missing = [word for word in (*_HAS, *sorted(task.__abstractmethods__)) if word in task.__abstractmethods__ or not hasattr(task, word)]
    if missing:
        raise ValueError(f"{name} has no {' and no '.join(missing)}, which each task has; see {Task.__module__}.Task")
    if not isinstance(task.horizon, int) or task.horizon < 1:
        raise ValueError(f"{name}: horizon is {task.horizon!r}; it is a number of steps, 1 or more")
    low, high = np.asarray(task.low), np.asarray(task.high)
    if low.shape != (3,) or high.shape != (3,) or not (low <= high).all():
        raise ValueError(f"{name}: low is {task.low} and high {task.high}; give x, y and z in m, and low not above high")


def same_task(one: str, other: str) -> bool:
    """Whether two names are those of one task; a file of your own may be named from another folder, see `task_digest`, too."""
    return one == other or ":" in one and Path(one).name == Path(other).name


def task_digest(name: str) -> str:
    """What tells tasks of your own apart whose files and classes have the same names; empty for those of this package."""
    return digest_of(name) if ":" in name and not name.startswith(f"{__name__}.") else ""


def warn_of_other(what: str, digest: str, name: str) -> None:
    """Warn that what was made for a task of your own was made for another content of its file.

    Args:
        what: What was made.
        digest: What `task_digest` gave then; empty if that is not known.
        name: Of the task now.
    """
    if digest and digest != task_digest(name):
        text = "%s was made for another %s: the file was changed since, or is another of this name"
        _logger.warning(text, what, Path(name).name)
