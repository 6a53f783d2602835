"""Errors as sentences for people."""

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.errors import ModelError, MotionError
from endo_sim_ros.core.folders import told_if_full
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.plugins import OwnError
from endo_sim_ros.messages import MessageError


def sentence(where: str, error: Exception) -> str:
    """What to tell the user about an error."""
    if isinstance(error, (MessageError, SequenceError, ModelError, MotionError, ConfigError, OwnError)):
        return str(error)  # written for the user, with the place in it
    if isinstance(error, (ValueError, OSError)):
        return told_if_full(error, where) or f"{where}: {error}"
    return f"{where}: unexpected {type(error).__name__}: {error}"
