"""`endo-sim` as a process, and in this one."""

import contextlib
import io
import subprocess
import sys
from pathlib import Path
from unittest import mock

from endo_sim_ros import cli

ROOT = Path(__file__).parents[1]


def endo_sim(*arguments, timeout: float = 120) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "endo_sim_ros.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout)


def endo_sim_here(*arguments) -> subprocess.CompletedProcess:
    """The same without a process, which takes two seconds of a core to start; for what needs none of its own."""
    words, output, errors = [str(word) for word in arguments], io.StringIO(), io.StringIO()
    with mock.patch.object(sys, "argv", ["endo-sim", *words]), contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        status = cli.main()
    return subprocess.CompletedProcess(words, status, output.getvalue(), errors.getvalue())
