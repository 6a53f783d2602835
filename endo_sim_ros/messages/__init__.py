"""numpy ⇄ ROS messages: the code twin of msg_conventions.md. Only this package encodes or decodes bytes.

Encoders take ``types``, the message classes to build: `ros_types()` for a running graph (the default), `bag_types()` for bag
files, which needs no ROS installation. Decoders accept messages of either. Images and clouds cross at memcpy speed.
"""

from endo_sim_ros.messages.cameras import CameraInfo, decode_camera_info, encode_camera_info
from endo_sim_ros.messages.clouds import (
    ControlNodeCloud,
    cut_number,
    decode_cloud,
    decode_control_nodes,
    decode_cut_surface,
    decode_gaussians,
    encode_control_nodes,
    encode_cut_surface,
    encode_gaussians,
)
from endo_sim_ros.messages.diagnostics import (
    ERROR,
    OK,
    STATE,
    WARN,
    BagPlayerState,
    ClientState,
    NodeState,
    NodeStatus,
    PhysicsState,
    PolicyState,
    ReconstructionState,
    RecorderState,
    RenderingState,
    ScriptedToolState,
    ViewerState,
    decode_diagnostics,
    encode_diagnostics,
)
from endo_sim_ros.messages.errors import MessageError
from endo_sim_ros.messages.headers import check_frame, encode_clock, stamp_to_ns
from endo_sim_ros.messages.images import decode_depth, decode_image, decode_mask, encode_image
from endo_sim_ros.messages.poses import decode_pose, decode_poses, decode_tip, encode_pose, encode_poses
from endo_sim_ros.messages.tools import (
    ToolDisplay,
    decode_cut,
    decode_jaw,
    decode_state_command,
    decode_wrench,
    encode_cut,
    encode_jaw,
    encode_operating_state,
    encode_tool_markers,
    encode_wrench,
)
from endo_sim_ros.messages.topics import (
    CAMERA_POSE,
    CLOCK,
    CONTROL_NODES,
    CUT_SURFACE,
    DEPTH,
    DIAGNOSTICS,
    GAUSSIANS,
    LEFT_COMPRESSED,
    LEFT_IMAGE,
    LEFT_INFO,
    MASK,
    MODEL_TOPICS,
    RECORDING_TOPICS,
    RENDERED_DEPTH,
    RENDERED_IMAGE,
    RENDERED_INFO,
    RENDERED_POSE,
    RENDERED_TOPICS,
    RIGHT_COMPRESSED,
    RIGHT_IMAGE,
    RIGHT_INFO,
    TOOL_MARKERS,
    TRAINING_CAMERA_INFO,
    TRAINING_CAMERAS,
    Topic,
    all_topics,
    tool_cut,
    tool_jaw,
    tool_jaw_move,
    tool_jaw_setpoint,
    tool_jaw_state,
    tool_move,
    tool_pose,
    tool_pose_command,
    tool_reaction,
    tool_setpoint,
    tool_state,
    tool_state_command,
    tool_wrench,
)
from endo_sim_ros.messages.types import (
    Message,
    MessageTypes,
    bag_types,
    crtk_type,
    ros_class,
    ros_types,
)

__all__ = [
    "BagPlayerState", "CAMERA_POSE", "CLOCK", "CONTROL_NODES", "CUT_SURFACE", "CameraInfo", "ClientState",
    "ControlNodeCloud", "DEPTH", "DIAGNOSTICS", "ERROR", "GAUSSIANS", "LEFT_COMPRESSED", "LEFT_IMAGE", "LEFT_INFO", "MASK",
    "MODEL_TOPICS", "Message", "MessageError", "MessageTypes",
    "NodeState", "NodeStatus", "OK", "PhysicsState", "PolicyState", "RECORDING_TOPICS", "RENDERED_DEPTH", "RENDERED_IMAGE",
    "RENDERED_INFO", "RENDERED_POSE", "RENDERED_TOPICS", "RIGHT_COMPRESSED", "RIGHT_IMAGE", "RIGHT_INFO", "ReconstructionState",
    "RecorderState", "RenderingState", "STATE", "ScriptedToolState", "TOOL_MARKERS",
    "TRAINING_CAMERAS", "TRAINING_CAMERA_INFO", "ToolDisplay", "Topic", "ViewerState", "WARN", "all_topics", "bag_types",
    "check_frame", "crtk_type", "cut_number", "decode_camera_info", "decode_cloud", "decode_control_nodes", "decode_cut",
    "decode_cut_surface", "decode_depth", "decode_diagnostics", "decode_gaussians", "decode_image", "decode_jaw", "decode_mask",
    "decode_pose", "decode_poses", "decode_state_command", "decode_tip", "decode_wrench", "encode_camera_info", "encode_clock",
    "encode_control_nodes", "encode_cut", "encode_cut_surface", "encode_diagnostics", "encode_gaussians", "encode_image",
    "encode_jaw", "encode_operating_state", "encode_pose", "encode_poses", "encode_tool_markers", "encode_wrench",
    "ros_class", "ros_types", "stamp_to_ns", "tool_cut", "tool_jaw", "tool_jaw_move", "tool_jaw_setpoint", "tool_jaw_state",
    "tool_move", "tool_pose", "tool_pose_command", "tool_reaction", "tool_setpoint", "tool_state", "tool_state_command",
    "tool_wrench",
]  # fmt: skip
