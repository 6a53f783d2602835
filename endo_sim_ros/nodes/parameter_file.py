"""The ROS parameter files in config/, generated from the configurations."""

import textwrap
from collections.abc import Sequence

from endo_sim_ros.core.config import StageConfig, options
from endo_sim_ros.nodes.bag_player_node import BagPlayerConfig
from endo_sim_ros.nodes.physics_node import PhysicsNodeConfig
from endo_sim_ros.nodes.policy_node import PolicyConfig
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNodeConfig
from endo_sim_ros.nodes.recorder_node import RecorderConfig
from endo_sim_ros.nodes.rendering_node import RenderingNodeConfig
from endo_sim_ros.nodes.scripted_tool_node import ScriptedToolConfig
from endo_sim_ros.nodes.viewer_node import ViewerNodeConfig
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.reconstruction import ReconstructionConfig
from endo_sim_ros.rendering import RenderingConfig
from endo_sim_ros.viewer.config import ViewerConfig

NODE_CONFIGS: dict[str, tuple[type[StageConfig], ...]] = {
    "reconstruction_node": (ReconstructionNodeConfig, ReconstructionConfig),
    "physics_node": (PhysicsNodeConfig, PhysicsConfig),
    "rendering_node": (RenderingNodeConfig, RenderingConfig),
    "bag_player": (BagPlayerConfig,),
    "recorder": (RecorderConfig,),
    "scripted_tool": (ScriptedToolConfig,),
    "policy": (PolicyConfig,),
    "viewer_node": (ViewerNodeConfig, ViewerConfig, RenderingConfig),
}


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
