"""The command line `endo-sim`. Each command is one file here, with a dataclass `Command`: its fields are the options.

Only the file of the command that runs is imported, and nothing heavy before its `run`.
"""

import ast
import atexit
import gc
import importlib
import logging
import os
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Container
from pathlib import Path
from typing import Any, Protocol

from endo_sim_ros import hear_interrupts
from endo_sim_ros.core.folders import told_if_full
from endo_sim_ros.core.plugins import told_where

# In the order of a user's way through the package.
COMMANDS = (
    *("demo", "view", "up", "convert", "phantom", "reconstruct", "compress", "touch", "record", "export"),
    *("identify", "train", "demonstrate", "imitate", "benchmark", "scene"),
    *("config", "evaluate", "report", "bench", "plot"),
)

# What the package raises for options and input that it cannot use, and Python for a path that cannot be read or written.
_WRONGLY_GIVEN = (ValueError, FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)


class Runnable(Protocol):
    """A command with its options."""

    def run(self) -> None:
        """Do what the command is for; what is wrong with its options raises."""


def summary(name: str) -> str:
    """The docstring of a command, which is not imported for it."""
    tree = ast.parse(Path(__file__).with_name(f"{name}.py").read_text())
    command = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Command")
    return ast.get_docstring(command) or ""


def overview() -> str:
    """What `endo-sim --help` prints."""
    lines = ["usage: endo-sim COMMAND [OPTIONS]", "", "Endoscope recordings become tissue that a robot can touch.", "", "commands:"]
    for name in COMMANDS:
        lines += textwrap.wrap(summary(name).partition("\n\n")[0], 100, initial_indent=f"  {name:13}", subsequent_indent=" " * 15)
    return "\n".join([*lines, "", "`endo-sim COMMAND --help` tells the options of a command."])


def parse(name: str, words: list[str]) -> Runnable:
    """The command with its options as the words give them; what is wrong with them ends the program with a sentence."""
    import tyro

    from endo_sim_ros.core.config import document_ranges, refuse_renamed_flags, refuse_repeated_flags

    module = importlib.import_module(f"endo_sim_ros.cli.{name}")
    command: type[Runnable] = module.Command
    refuse_repeated_flags(words)
    refuse_renamed_flags(words, command)
    document_ranges(command)
    default: Any = module.defaults(words) if hasattr(module, "defaults") else None
    return tyro.cli(command, prog=f"endo-sim {name}", description=summary(name), args=words, default=default)


def chosen(words: list[str], flag: str, names: Container[str]) -> str:
    """Return which of these names the words give a flag, default if none: what tyro then refuses."""
    name = "default"
    for word, following in zip(words, [*words[1:], ""]):
        if word == flag or word.startswith(f"{flag}="):
            name = following if word == flag else word.removeprefix(f"{flag}=")
    return name if name in names else "default"


def _hear_signals() -> None:
    """Let Ctrl-C, SIGTERM and SIGHUP end the program by an exception, wherever it is."""
    hear_interrupts()
    for number in (signal.SIGTERM, signal.SIGHUP):  # of a job's end and a closed terminal: what Ctrl-C cleans up, they do
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, lambda number, frame: sys.exit(128 + number))
    sys.unraisablehook = _ignored


def _ignored(what: Any) -> None:
    """Send a signal once more whose exception met a callback that Python lets raise nothing, as imports and garbage have many."""
    error = what.exc_value
    if isinstance(error, KeyboardInterrupt):
        number = signal.SIGINT
    elif isinstance(error, SystemExit) and isinstance(error.code, int) and error.code > 128:
        number = error.code - 128
    else:
        return sys.__unraisablehook__(what)
    threading.Timer(0.1, os.kill, (os.getpid(), number)).start()


def main() -> int:
    """Run the command line; returns the exit status: 2 if options or input are wrong, 1 if something failed later, 130 after Ctrl-C.

    SIGTERM and SIGHUP raise SystemExit with 143 and 129.
    """
    _hear_signals()
    words = sys.argv[1:]
    if not {"-h", "--help"}.isdisjoint(words):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # help that `head` or `less` has read enough of ends without an error
    if not words or words[0] in ("-h", "--help"):
        print(overview())
        return 0 if words else 2
    name, *words = words
    if name not in COMMANDS:
        print(f"endo-sim: there is no command {name}; the commands are {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    shown = logging.StreamHandler()
    # What others tell is for programmers, as what torch says when it is interrupted.
    shown.addFilter(lambda record: record.levelno > logging.INFO or record.name.startswith("endo_sim_ros"))
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[shown])
    atexit.register(gc.freeze)  # looking for garbage in all that was imported, torch above all, takes a second before the command ends
    start = time.monotonic()
    try:
        with told_where():
            parse(name, words).run()
    except KeyboardInterrupt:
        return 130
    except (ImportError, RuntimeError, ValueError, OSError) as error:
        print(f"endo-sim: {_told(error)}", file=sys.stderr)
        return 2 if isinstance(error, _WRONGLY_GIVEN) else 1
    logging.getLogger(__name__).info("done in %.0f s", time.monotonic() - start)
    return 0


def _told(error: Exception) -> str:
    """What an error says; of one of the GPU the first line, as the others are for programmers."""
    if told := told_if_full(error):
        return told
    first, *others = str(error).splitlines() or [type(error).__name__]
    if isinstance(error, RuntimeError) and "CUDA error" in first:
        return f"the GPU failed ({first}); what was finished is kept; see what nvidia-smi says, or go on with --device cpu"
    return "\n".join([first, *others])
