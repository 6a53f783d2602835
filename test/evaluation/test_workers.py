"""Jobs in processes that crash lose only themselves."""

import multiprocessing
import os
import re
import signal

import pytest

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation.workers import Finished, News, run_in_processes

pytestmark = pytest.mark.dds


def _temperamental(argument, device, report):
    report(f"begun on {device}")
    if argument == "raise":
        raise ArithmeticError("no sum")
    if argument == "refuse":
        raise SequenceError("not this one")
    if argument == "exit":
        os._exit(3)
    if argument == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    return argument * 2, os.environ["ENDO_SIM_THREADS"]


@pytest.mark.slow
def test_a_job_that_crashes_loses_only_itself():
    arguments = ["a", "raise", "exit", "b", "kill", "refuse", "c"]
    events = list(run_in_processes(_temperamental, arguments, ["cpu", "cpu"]))
    ends = {event.index: event for event in events if isinstance(event, Finished)}
    assert sorted(ends) == list(range(7))
    assert {ends[i].result[0] for i in (0, 3, 6)} == {"aa", "bb", "cc"}
    assert re.fullmatch(r"ArithmeticError: no sum \(test_workers.py:\d+\)", ends[1].error)
    assert ends[2].error == "its process ended with exit code 3"
    assert ends[4].error == "its process was ended by SIGKILL, as when memory runs out"
    assert ends[5].error == "not this one"
    assert News(0, "begun on cpu") in events


def test_ctrl_c_while_a_process_begins_is_that_and_no_other_error(monkeypatch):
    def interrupted(process):
        raise KeyboardInterrupt

    monkeypatch.setattr(multiprocessing.get_context("forkserver").Process, "start", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(run_in_processes(_temperamental, ["a"], ["cpu"]))
