"""numpy ⇄ ROS messages: the code twin of msg_conventions.md. Only this package encodes or decodes bytes.

Every encoder takes ``types``, the message classes to build: `ros_types()` for a running graph (the default), `bag_types()` for
bag files, which needs no ROS installation. Decoders accept messages of either. Images and clouds cross at memcpy speed.
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
    NODE_STATES,
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
from endo_sim_ros.messages.poses import decode_pose, decode_poses, encode_pose, encode_poses
from endo_sim_ros.messages.tools import (
    METRES_PER_NEWTON,
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
    TOOL_TOPICS,
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
    MESSAGE_PACKAGES,
    BagTypes,
    Message,
    MessageTypes,
    RosTypes,
    bag_types,
    crtk_type,
    ros_class,
    ros_types,
)
