"""The states of each node, for tests of all of them."""

from endo_sim_ros.messages import (
    BagPlayerState,
    IdentificationState,
    NodeState,
    PhysicsState,
    PolicyState,
    ReconstructionState,
    RecorderState,
    RenderingState,
    ScriptedToolState,
    ViewerState,
)

NODE_STATES: dict[str, type[NodeState]] = {  # by the default name of the node
    "reconstruction_node": ReconstructionState,
    "physics_node": PhysicsState,
    "rendering_node": RenderingState,
    "identification_node": IdentificationState,
    "viewer_node": ViewerState,
    "bag_player": BagPlayerState,
    "recorder": RecorderState,
    "policy": PolicyState,
    "scripted_tool": ScriptedToolState,
}
