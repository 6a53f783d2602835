"""The newest model, its control nodes and its cuts, as nodes that show tissue receive them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.messages import ControlNodeCloud
from endo_sim_ros.nodes.background import Background
from endo_sim_ros.nodes.base import STREAM_DEPTH
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig


@dataclass(frozen=True)
class BoundModel:
    """A renderer of one model, skinned to one set of control nodes."""

    renderer: DeformableRenderer
    model_stamp: int  # ns
    node_rest: np.ndarray | None  # [M, 3] m, world; None without control nodes: the model is rendered at rest only

    def follows(self, nodes: ControlNodeCloud | None) -> bool:
        """Whether the renderer can show the state of these control nodes: same model, same positions at rest."""
        return (
            nodes is not None
            and self.node_rest is not None
            and nodes.model_stamp_ns == self.model_stamp
            and np.array_equal(nodes.rest, self.node_rest)
        )


class ModelTracker:
    """Keeps the newest model that was received and the newest one that is bound to its control nodes.

    The two differ while the newest is bound in the background.

    Args:
        kept_cuts: Number of cut surfaces that are kept for states that arrive late.

    Attributes:
        model: The newest model, or None.
        model_stamp: Its stamp, ns.
        bound: The newest bound model, or None.
    """

    def __init__(self, kept_cuts: int = STREAM_DEPTH) -> None:
        self.model: GaussianModel | None = None
        self.model_stamp = 0
        self.bound: BoundModel | None = None
        self._model_number = 0  # in the order of arrival; stamps may repeat
        self._cuts = {0: np.zeros((0, 3, 3), np.float32)}  # surfaces by their number, the newest last
        self._kept_cuts = kept_cuts
        self._spots: list[DyedSpot] = []
        self._background = Background()

    def receive_model(self, message: Any, world_frame: str) -> None:
        """Decode and keep a message of the topic gaussians.

        Raises:
            MessageError: If it cannot be used.
        """
        messages.check_frame(message, (world_frame,), messages.GAUSSIANS.name)
        self.model = messages.decode_gaussians(message)
        self.model_stamp = messages.stamp_to_ns(message.header.stamp)
        self._model_number += 1

    def receive_cut_surface(self, message: Any, world_frame: str) -> None:
        """Decode and keep a message of the topic cut_surface.

        Raises:
            MessageError: If it cannot be used.
        """
        messages.check_frame(message, (world_frame,), messages.CUT_SURFACE.name)
        triangles = messages.decode_cut_surface(message)
        number = messages.cut_number(triangles)
        if number:
            self._cuts[number] = triangles
        while len(self._cuts) > self._kept_cuts:
            del self._cuts[list(self._cuts)[1]]

    def receive_dye(self, message: Any, world_frame: str) -> None:
        """Decode and show a message of the topic dye.

        Raises:
            MessageError: If it cannot be used; the spots before stay.
        """
        self._spots = messages.decode_dye(message, world_frame, messages.DYE.name)
        if self.bound is not None:
            self.bound.renderer.dye(self._spots)

    def has_cut(self, nodes: ControlNodeCloud) -> bool:
        """Whether the cut surface of this state has arrived."""
        return nodes.cut in self._cuts

    def bind(self, nodes: ControlNodeCloud | None, config: RenderingConfig) -> bool:
        """Bind the newest model to its control nodes in the background; call it periodically.

        Args:
            nodes: The newest control nodes; without those of the newest model it is bound at rest.
            config: Options of the renderer.

        Returns:
            Whether `bound` is new. An error of the binding is raised once.
        """
        built = self._background.take()
        if built is not None:
            _, bound = built
            bound.renderer.dye(self._spots)
            self.bound = bound
        if self.model is not None:
            model, stamp = self.model, self.model_stamp
            rest = nodes.rest if nodes is not None and nodes.model_stamp_ns == stamp else None
            key = (self._model_number, b"" if rest is None else rest.tobytes(), config)
            self._background.want(key, lambda: BoundModel(DeformableRenderer(model, rest, config), stamp, rest))
        return built is not None

    def cut(self, bound: BoundModel, nodes: ControlNodeCloud) -> None:
        """Part the skin of a bound model along the cut surface of this state, if that has arrived."""
        if self.has_cut(nodes):
            bound.renderer.cut(self._cuts[nodes.cut])

    def stop(self) -> None:
        """Bind nothing more."""
        self._background.stop()
