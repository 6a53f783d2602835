"""The ROS parameter files in config/, generated from the configurations."""

import textwrap
from collections.abc import Sequence

from endo_sim_ros.core.config import Option, options
from endo_sim_ros.nodes.configs import CHOSEN_BY, NODE_CONFIGS

_WIDTH = 110  # characters of a line of text
_ABOUT_PRESETS = """\
A parameter with a value in this file has that value, whatever the {0}. Parameters that some {0} changes are
therefore commented out below, with the value of the {0} default: remove the # to give one a value of your own."""


def parameter_file(nodes: Sequence[str] = tuple(NODE_CONFIGS)) -> str:
    """A YAML file with every parameter of some nodes at its default, each under its description and range.

    Parameters whose values come from a preset or tissue are commented out: given in a file they would outweigh it.

    Args:
        nodes: Names of ROS nodes, keys of `NODE_CONFIGS`.
    """
    lines = []
    for node in nodes:
        lines += [f"/**/{node}:", "  ros__parameters:"]
        for config_class in NODE_CONFIGS[node]:
            chooser, sets = CHOSEN_BY.get(config_class, ("", {}))
            of_presets = {name for values in sets.values() for name in values}
            if of_presets:
                lines += ["", *(f"    # {line}" for line in textwrap.wrap(_ABOUT_PRESETS.format(chooser), _WIDTH)), ""]
            for option in options(config_class):
                lines += [f"    # {line}" for line in textwrap.wrap(_description(option), _WIDTH)]
                lines.append(f"    {'#' * (option.name in of_presets)}{option.name}: {_yaml(option.default)}")
        lines.append("")
    return "\n".join(lines)


def _description(option: Option) -> str:
    """What an option is, with its range or its choices."""
    return option.help + (f" [{', '.join(option.choices)}]" if option.choices else "")


def _yaml(value: bool | int | float | str | tuple[str, ...]) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_yaml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(value) if "e" not in repr(value) else f"{value:.10f}".rstrip("0")
    return f'"{value}"' if isinstance(value, str) else str(value)
