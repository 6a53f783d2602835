"""The ROS parameter files in config/, generated from the configurations."""

import textwrap
from collections.abc import Sequence

from endo_sim_ros.core.config import options
from endo_sim_ros.nodes.configs import NODE_CONFIGS


def parameter_file(nodes: Sequence[str] = tuple(NODE_CONFIGS)) -> str:
    """A YAML file with every parameter of the nodes at its default, each under its description and range."""
    lines = []
    for node in nodes:
        lines += [f"/**/{node}:", "  ros__parameters:"]
        for config_class in NODE_CONFIGS[node]:
            for option in options(config_class):
                text = option.description
                if option.range:
                    low, high, unit = option.range
                    text += f" [{low:g} to {high:g}{' ' + unit if unit else ''}]"
                if option.choices:
                    text += f" [{', '.join(option.choices)}]"
                lines += [f"    # {line}" for line in textwrap.wrap(text, 110)]
                lines.append(f"    {option.name}: {_yaml(option.default)}")
        lines.append("")
    return "\n".join(lines)


def _yaml(value: bool | int | float | str | tuple[str, ...]) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_yaml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(value) if "e" not in repr(value) else f"{value:.10f}".rstrip("0")
    return f'"{value}"' if isinstance(value, str) else str(value)
