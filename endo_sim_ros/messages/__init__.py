"""numpy ⇄ ROS messages: the code twin of msg_conventions.md. Only this package encodes or decodes bytes.

Encoders take ``types``, the message classes to build: `ros_types()` for a running graph (the default), `bag_types()` for bag
files, which needs no ROS installation. Decoders accept messages of either. Images and clouds cross at memcpy speed.
"""

from endo_sim_ros.messages.cameras import (
    CameraInfo as CameraInfo,
    decode_camera_info as decode_camera_info,
    encode_camera_info as encode_camera_info,
)
from endo_sim_ros.messages.clouds import (
    ControlNodeCloud as ControlNodeCloud,
    cut_number as cut_number,
    decode_cloud as decode_cloud,
    decode_control_nodes as decode_control_nodes,
    decode_cut_surface as decode_cut_surface,
    decode_gaussians as decode_gaussians,
    encode_control_nodes as encode_control_nodes,
    encode_cut_surface as encode_cut_surface,
    encode_gaussians as encode_gaussians,
)
from endo_sim_ros.messages.diagnostics import (
    ERROR as ERROR,
    OK as OK,
    STATE as STATE,
    WARN as WARN,
    BagPlayerState as BagPlayerState,
    ClientState as ClientState,
    NodeState as NodeState,
    NodeStatus as NodeStatus,
    PhysicsState as PhysicsState,
    PolicyState as PolicyState,
    ReconstructionState as ReconstructionState,
    RecorderState as RecorderState,
    RenderingState as RenderingState,
    ScriptedToolState as ScriptedToolState,
    ViewerState as ViewerState,
    decode_diagnostics as decode_diagnostics,
    encode_diagnostics as encode_diagnostics,
)
from endo_sim_ros.messages.headers import check_frame as check_frame, encode_clock as encode_clock, stamp_to_ns as stamp_to_ns
from endo_sim_ros.messages.images import (
    decode_depth as decode_depth,
    decode_image as decode_image,
    decode_mask as decode_mask,
    encode_image as encode_image,
)
from endo_sim_ros.messages.poses import (
    decode_pose as decode_pose,
    decode_poses as decode_poses,
    decode_tip as decode_tip,
    encode_pose as encode_pose,
    encode_poses as encode_poses,
)
from endo_sim_ros.messages.tools import (
    ToolDisplay as ToolDisplay,
    decode_cut as decode_cut,
    decode_jaw as decode_jaw,
    decode_state_command as decode_state_command,
    decode_wrench as decode_wrench,
    encode_cut as encode_cut,
    encode_jaw as encode_jaw,
    encode_operating_state as encode_operating_state,
    encode_tool_markers as encode_tool_markers,
    encode_wrench as encode_wrench,
)
from endo_sim_ros.messages.topics import (
    CAMERA_POSE as CAMERA_POSE,
    CLOCK as CLOCK,
    CONTROL_NODES as CONTROL_NODES,
    CUT_SURFACE as CUT_SURFACE,
    DEPTH as DEPTH,
    DIAGNOSTICS as DIAGNOSTICS,
    GAUSSIANS as GAUSSIANS,
    LEFT_COMPRESSED as LEFT_COMPRESSED,
    LEFT_IMAGE as LEFT_IMAGE,
    LEFT_INFO as LEFT_INFO,
    MASK as MASK,
    MODEL_TOPICS as MODEL_TOPICS,
    RECORDING_TOPICS as RECORDING_TOPICS,
    RENDERED_DEPTH as RENDERED_DEPTH,
    RENDERED_IMAGE as RENDERED_IMAGE,
    RENDERED_INFO as RENDERED_INFO,
    RENDERED_POSE as RENDERED_POSE,
    RENDERED_TOPICS as RENDERED_TOPICS,
    RIGHT_COMPRESSED as RIGHT_COMPRESSED,
    RIGHT_IMAGE as RIGHT_IMAGE,
    RIGHT_INFO as RIGHT_INFO,
    TOOL_MARKERS as TOOL_MARKERS,
    TRAINING_CAMERA_INFO as TRAINING_CAMERA_INFO,
    TRAINING_CAMERAS as TRAINING_CAMERAS,
    Topic as Topic,
    all_topics as all_topics,
    tool_cut as tool_cut,
    tool_jaw as tool_jaw,
    tool_jaw_move as tool_jaw_move,
    tool_jaw_setpoint as tool_jaw_setpoint,
    tool_jaw_state as tool_jaw_state,
    tool_move as tool_move,
    tool_pose as tool_pose,
    tool_pose_command as tool_pose_command,
    tool_reaction as tool_reaction,
    tool_setpoint as tool_setpoint,
    tool_state as tool_state,
    tool_state_command as tool_state_command,
    tool_wrench as tool_wrench,
)
from endo_sim_ros.messages.types import (
    Message as Message,
    MessageError as MessageError,
    MessageTypes as MessageTypes,
    bag_types as bag_types,
    crtk_type as crtk_type,
    ros_class as ros_class,
    ros_types as ros_types,
)
