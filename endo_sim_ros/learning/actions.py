"""What the numbers of actions mean, what acts by them, and what is observed beside the state of a task for them."""

from typing import Literal

from endo_sim_ros.instruments import JOINTS

Actions = Literal["cartesian", "joints", "joint_positions"]
"""How far the tip of the tool moves, how far the joints of its arm move, or where these are; see `TaskBatch`."""

Contact = Literal["point", "links"]
"""What touches the tissue: the tip as a task describes it, or the links of the instrument; see `TaskBatch`."""

ACTION_SIZES: dict[str, int] = {"cartesian": 4, "joints": len(JOINTS) + 1, "joint_positions": len(JOINTS) + 1}
"""How many numbers an action has."""


def observed_names(names: tuple[str, ...], actions: Actions) -> tuple[str, ...]:
    """Names of the numbers of the state: those of a task, and with actions of joints the joints."""
    return names if actions == "cartesian" else names + JOINTS
