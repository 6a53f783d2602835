"""Tips of tools and their forces, in the scene that browsers draw."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from endo_sim_ros.viewer.browser import CENTIMETRES

ARROW = 1.0  # cm per newton, as in tool_markers


@dataclass(frozen=True)
class Tool:
    """A tool, and what it does to the tissue."""

    position: np.ndarray  # [3] m, world
    force: np.ndarray  # [3] N on the tissue, world


class ToolMarks:
    """A point for each tip, an arrow for each force, and its number.

    Args:
        scene: Where they are drawn.
    """

    def __init__(self, scene: Any):
        nowhere = np.zeros((1, 3), np.float32)
        self._scene = scene
        self.tips = scene.add_point_cloud(
            "/tips", nowhere, (235, 235, 235), point_size=0.25, point_shape="circle", precision="float32", visible=False
        )
        self.arrows = scene.add_arrows(
            "/forces", np.eye(3)[None, :2], (255, 140, 25), shaft_radius=0.06, head_radius=0.15, head_length=0.3, visible=False
        )
        self.labels: dict[str, Any] = {}

    def draw(self, tools: dict[str, Tool]) -> None:
        """Draw all tools, by name."""
        tips = np.array([tool.position for tool in tools.values()]).reshape(-1, 3) * CENTIMETRES
        ends = tips + ARROW * np.array([tool.force for tool in tools.values()]).reshape(-1, 3)
        pulling = np.linalg.norm(ends - tips, axis=1) > 0.02
        self.tips.visible, self.arrows.visible = bool(len(tips)), bool(pulling.any())
        if len(tips):
            self.tips.points = tips.astype(np.float32)
        if pulling.any():
            self.arrows.points = np.stack([tips, ends], 1)[pulling].astype(np.float32)
        for name in self.labels.keys() - tools.keys():
            self.labels.pop(name).remove()
        for name, tip in zip(tools, tips):
            if name not in self.labels:
                self.labels[name] = self._scene.add_label(f"/force_of/{name}", "", font_screen_scale=1.2, anchor="bottom-left")
            self.labels[name].position = tip
            self.labels[name].text = f"{np.linalg.norm(tools[name].force):.1f} N"
