"""`endo-sim` as a process."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def endo_sim(*arguments, timeout: float = 120) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "endo_sim_ros.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout)
