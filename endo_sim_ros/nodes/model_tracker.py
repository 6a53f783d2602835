"""What nodes that show tissue keep of what they hear: the newest model, bound to its control nodes, and its cuts."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.messages import ControlNodeCloud
from endo_sim_ros.nodes.background import Background
from endo_sim_ros.nodes.base import STREAM_DEPTH
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig


@dataclass(frozen=True)
class Bound:
    """A renderer and what it is for."""

    renderer: DeformableRenderer
    model_stamp: int
    node_rest: np.ndarray | None  # [M, 3] m, None without control nodes

    def follows(self, nodes: ControlNodeCloud | None) -> bool:
        """Whether it can show the state of these nodes."""
        return (
            nodes is not None
            and self.node_rest is not None
            and nodes.model_stamp_ns == self.model_stamp
            and np.array_equal(nodes.rest, self.node_rest)
        )


class ShownTissue:
    """The newest model that was heard, and the one that can be shown; they differ while it is bound.

    Args:
        kept_cuts: How many of the newest cut surfaces are kept for states that come late.
    """

    def __init__(self, kept_cuts: int = STREAM_DEPTH):
        self.model: GaussianModel | None = None  # the newest; its stamp, and number in the order of arrival:
        self.model_stamp, self._model_number = 0, 0
        self.bound: Bound | None = None
        self._cuts = {0: np.zeros((0, 3, 3), np.float32)}  # surfaces by their number, the newest last
        self._kept_cuts = kept_cuts
        self._background = Background()

    def take_model(self, message: Any, world_frame: str) -> None:
        """Take in a message on gaussians."""
        messages.check_frame(message, (world_frame,), messages.GAUSSIANS.name)
        self.model = messages.decode_gaussians(message)
        self.model_stamp = messages.stamp_to_ns(message.header.stamp)
        self._model_number += 1

    def take_cut_surface(self, message: Any, world_frame: str) -> None:
        """Take in a message on cut_surface."""
        messages.check_frame(message, (world_frame,), messages.CUT_SURFACE.name)
        triangles = messages.decode_cut_surface(message)
        number = messages.cut_number(triangles)
        if number:
            self._cuts[number] = triangles
        while len(self._cuts) > self._kept_cuts:
            del self._cuts[list(self._cuts)[1]]

    def knows_cut(self, nodes: ControlNodeCloud) -> bool:
        """Whether the surface of this state is there; else it is still on its way."""
        return nodes.cut in self._cuts

    def bind(self, nodes: ControlNodeCloud | None, config: RenderingConfig) -> bool:
        """Bind the newest model to its control nodes in the background, without any as it is at rest; call again and again.

        Returns:
            Whether ``bound`` is new. Raises what the binding raised, once.
        """
        built = self._background.take()
        if built is not None:
            self.bound = built[1]
        if self.model is not None:
            model, stamp = self.model, self.model_stamp
            rest = nodes.rest if nodes is not None and nodes.model_stamp_ns == stamp else None
            key = (self._model_number, b"" if rest is None else rest.tobytes(), config)
            self._background.want(key, lambda: Bound(DeformableRenderer(model, rest, config), stamp, rest))
        return built is not None

    def cut(self, bound: Bound, nodes: ControlNodeCloud) -> None:
        """Part the skin as it is in the state of these nodes."""
        if self.knows_cut(nodes):
            bound.renderer.cut(self._cuts[nodes.cut])

    def stop(self) -> None:
        """Begin nothing more."""
        self._background.stop()
