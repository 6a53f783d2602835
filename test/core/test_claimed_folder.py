"""A folder for results takes those of one command at a time."""

import os
import subprocess
import sys

import pytest

from endo_sim_ros.core.folders import claimed, leaving_none_empty

_HOLDS = """
import sys
from pathlib import Path
from endo_sim_ros.core.folders import claimed
with claimed(Path(sys.argv[1])):
    print("claimed", flush=True)
    input()
"""


def test_another_process_has_to_wait_until_it_ends_or_is_killed(tmp_path):
    folder = tmp_path / "new" / "results"
    command = [sys.executable, "-c", _HOLDS, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "claimed\n"
        with pytest.raises(ValueError, match=f"^{folder}: another command writes into it; wait .* name another folder$"), claimed(folder):
            pass
        other.kill()
    with claimed(folder), claimed(tmp_path):
        (folder / "file").touch()
    with claimed(folder):
        assert (folder / "file").exists()


def test_nothing_is_left_of_one_that_was_made_for_it(tmp_path):
    open_before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(KeyboardInterrupt), leaving_none_empty(tmp_path / "a" / "b"), claimed(tmp_path / "a" / "b"):
        raise KeyboardInterrupt
    assert not (tmp_path / "a").exists()
    assert len(os.listdir("/proc/self/fd")) == open_before


def test_a_file_is_refused_in_one_sentence(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"file: no files can be written there .*; name another folder$"), claimed(tmp_path / "file"):
        pass
