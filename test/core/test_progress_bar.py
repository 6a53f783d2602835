"""A stage whose length is not known is not shown as part of the one before."""

from rich.progress import Progress

from endo_sim_ros.core.progress_bar import stages_in


def test_a_stage_of_unknown_length_pulses_after_one_of_a_known_length():
    bar = Progress(disable=True)
    task = bar.add_task("poses", total=None)
    on_progress = stages_in(bar, task)
    on_progress("matching", 7, 9)
    assert (bar.tasks[0].description, bar.tasks[0].completed, bar.tasks[0].total) == ("matching", 7, 9)
    on_progress("matching", 9, 9)
    assert bar.finished
    on_progress("mapping", 0, 0)
    assert (bar.tasks[0].description, bar.tasks[0].completed, bar.tasks[0].total) == ("mapping", 0, None)
    on_progress("training", 5, 10)
    assert not bar.finished and bar.tasks[0].total == 10 and bar.tasks[0].finished_time is None
