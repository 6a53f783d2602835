"""Stages of long work in one bar of the terminal."""

from collections.abc import Callable

from rich.progress import Progress, TaskID


def stages_in(bar: Progress, task: TaskID) -> Callable[[str, int, int], None]:
    """Return a callback ``on_progress(stage, done, total)`` that shows a stage in a task of a bar; where the total is 0 the bar pulses."""
    (shown,) = (each for each in bar.tasks if each.id == task)

    def on_progress(stage: str, done: int, total: int) -> None:
        shown.total = total or None  # `update` keeps that of the stage before where there is none
        bar.update(task, description=stage, completed=done)

    return on_progress
