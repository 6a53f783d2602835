"""A folder for files of one process."""

import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from endo_sim_ros.core.temporary_folder import temporary_folder

_HOLDS = """
from pathlib import Path
from endo_sim_ros.core.temporary_folder import temporary_folder
folder = temporary_folder()
Path(folder.name, "1").write_bytes(bytes(1 << 20))
print(folder.name, flush=True)
input()
"""


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)  # what was found before
    return tmp_path


@pytest.fixture
def holders(temporary):
    """Two processes with a folder each."""
    command = [sys.executable, "-c", _HOLDS]
    processes = [subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    yield [(process, Path(process.stdout.readline().strip())) for process in processes]
    for process in processes:
        process.kill()
        process.communicate()


def test_the_folder_of_a_killed_process_is_removed_and_that_of_a_living_one_is_not(holders, temporary):
    (dead, left), (_, lives) = holders
    result = temporary / "endo_sim_model"
    result.mkdir()
    dead.kill()
    dead.wait()
    assert left.is_dir() and lives.is_dir()
    folder = temporary_folder()
    assert {*temporary.iterdir()} == {Path(folder.name), lives, result} and (lives / "1").is_file()
    folder.cleanup()
    assert {*temporary.iterdir()} == {lives, result}


def test_a_folder_of_another_user_is_left_alone(holders, temporary, monkeypatch):
    for process, _ in holders:
        process.kill()
        process.wait()
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    temporary_folder().cleanup()
    assert {*temporary.iterdir()} == {folder for _, folder in holders}


def test_a_folder_that_another_process_removes_before_it_is_locked_is_made_anew(temporary, monkeypatch):
    flock, removed = fcntl.flock, []

    def slow(lock, operation):
        if not removed:
            removed.extend(temporary.iterdir())
            shutil.rmtree(removed[0])
        flock(lock, operation)

    monkeypatch.setattr(fcntl, "flock", slow)
    folder = temporary_folder()
    assert removed and [*temporary.iterdir()] == [Path(folder.name)] != removed
    folder.cleanup()
