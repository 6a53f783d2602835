"""Stages of long work in one bar of the terminal."""

from collections.abc import Callable

from rich.progress import Progress, TaskID


def stages_in(bar: Progress, task: TaskID) -> Callable[[str, int, int], None]:
    """Return a callback ``on_progress(stage, done, total)`` that shows a stage in a task of a bar; where the total is 0 the bar pulses."""
    (shown,) = (each for each in bar.tasks if each.id == task)

    def on_progress(stage: str, done: int, total: int) -> None:
        if stage != shown.description:
            bar.reset(task)
            shown.total = None  # neither `reset` nor `update` takes that of the stage before away
        bar.update(task, description=stage, completed=done, total=total or None)

    return on_progress
