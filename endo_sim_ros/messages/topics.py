"""Topics of the contract: name, type and quality of service of each, as in msg_conventions.md."""

from collections.abc import Callable
from typing import NamedTuple

from endo_sim_ros.messages.types import crtk_type


class Topic(NamedTuple):
    """A topic: relative name, full name of the message type, and quality of service (``stream`` or ``latched``)."""

    name: str
    type: str
    qos: str = "stream"


LEFT_IMAGE = Topic("endoscope/left/image_raw", "sensor_msgs/msg/Image")
LEFT_COMPRESSED = Topic("endoscope/left/image_raw/compressed", "sensor_msgs/msg/CompressedImage")
LEFT_INFO = Topic("endoscope/left/camera_info", "sensor_msgs/msg/CameraInfo")
RIGHT_IMAGE = Topic("endoscope/right/image_raw", "sensor_msgs/msg/Image")
RIGHT_COMPRESSED = Topic("endoscope/right/image_raw/compressed", "sensor_msgs/msg/CompressedImage")
RIGHT_INFO = Topic("endoscope/right/camera_info", "sensor_msgs/msg/CameraInfo")
DEPTH = Topic("endoscope/left/depth", "sensor_msgs/msg/Image")
MASK = Topic("endoscope/left/mask", "sensor_msgs/msg/Image")
CAMERA_POSE = Topic("ECM/measured_cp", "geometry_msgs/msg/PoseStamped")

GAUSSIANS = Topic("gaussians", "sensor_msgs/msg/PointCloud2", "latched")
TRAINING_CAMERAS = Topic("training_cameras", "geometry_msgs/msg/PoseArray", "latched")
TRAINING_CAMERA_INFO = Topic("training_camera_info", "sensor_msgs/msg/CameraInfo", "latched")
FOUND_MOTION = Topic("found_motion", "std_msgs/msg/String", "latched")
CONTROL_NODES = Topic("control_nodes", "sensor_msgs/msg/PointCloud2")
CUT_SURFACE = Topic("cut_surface", "sensor_msgs/msg/PointCloud2", "latched")
DYE = Topic("dye", "visualization_msgs/msg/MarkerArray", "latched")
STIFFNESS_MAP = Topic("stiffness_map", "sensor_msgs/msg/PointCloud2", "latched")
TISSUE_MOTION = Topic("tissue_motion", "sensor_msgs/msg/JointState")
TISSUE_MOTION_COMMAND = Topic("set_tissue_motion", "sensor_msgs/msg/JointState")
THING_POSES = Topic("thing_poses", "sensor_msgs/msg/PointCloud2")
TASK_OUTCOME = Topic("task_outcome", "sensor_msgs/msg/JointState")
RENDERED_IMAGE = Topic("rendered/image_raw", "sensor_msgs/msg/Image")
RENDERED_INFO = Topic("rendered/camera_info", "sensor_msgs/msg/CameraInfo")
RENDERED_POSE = Topic("rendered/camera_pose", "geometry_msgs/msg/PoseStamped")
RENDERED_DEPTH = Topic("rendered/depth/image", "sensor_msgs/msg/Image")
RENDERED_SEGMENTATION = Topic("rendered/segmentation/image", "sensor_msgs/msg/Image")
RENDERED_COMPRESSED = Topic("rendered/image_raw/compressed", "sensor_msgs/msg/CompressedImage")
RENDERED_RIGHT_IMAGE = Topic("rendered/right/image_raw", "sensor_msgs/msg/Image")
RENDERED_RIGHT_COMPRESSED = Topic("rendered/right/image_raw/compressed", "sensor_msgs/msg/CompressedImage")
RENDERED_RIGHT_INFO = Topic("rendered/right/camera_info", "sensor_msgs/msg/CameraInfo")
TOOL_MARKERS = Topic("tool_markers", "visualization_msgs/msg/MarkerArray")
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock")


def _of_arm(name: str, kind: str, qos: str = "stream") -> Callable[[str], Topic]:
    """Function from the name of an arm to its topic; a type without a package is one of crtk_msgs."""
    return lambda arm: Topic(f"{arm}/{name}", kind if "/" in kind else crtk_type(kind), qos)


tool_pose = _of_arm("measured_cp", "geometry_msgs/msg/PoseStamped")
"""Measured pose of an arm's tip."""
tool_pose_command = _of_arm("servo_cp", "geometry_msgs/msg/PoseStamped")
"""Commanded pose of an arm's tip, reached at once."""
tool_move = _of_arm("move_cp", "geometry_msgs/msg/PoseStamped")
"""Goal to which an arm's tip moves."""
tool_setpoint = _of_arm("setpoint_cp", "geometry_msgs/msg/PoseStamped")
"""Current setpoint of an arm's tip."""
tool_wrench = _of_arm("body/servo_cf", "geometry_msgs/msg/WrenchStamped")
"""Commanded wrench, tool on tissue."""
tool_reaction = _of_arm("body/measured_cf", "geometry_msgs/msg/WrenchStamped")
"""Measured wrench, tissue on tool."""
tool_spatial_wrench = _of_arm("spatial/servo_cf", "geometry_msgs/msg/WrenchStamped")
"""Commanded wrench, tool on tissue, as the base of the arm tells it."""
tool_spatial_reaction = _of_arm("spatial/measured_cf", "geometry_msgs/msg/WrenchStamped")
"""Measured wrench, tissue on tool, as the base of the arm tells it."""
tool_jaw = _of_arm("jaw/servo_jp", "sensor_msgs/msg/JointState")
"""Commanded angle of an arm's jaw, reached at once."""
tool_jaw_move = _of_arm("jaw/move_jp", "sensor_msgs/msg/JointState")
"""Goal to which an arm's jaw moves."""
tool_jaw_effort = _of_arm("jaw/servo_jf", "sensor_msgs/msg/JointState")
"""Commanded effort of an arm's jaw, which is refused: joints are ideal."""
tool_joint_effort = _of_arm("servo_jf", "sensor_msgs/msg/JointState")
"""Commanded efforts of an arm's joints, which are refused likewise."""
tool_wrench_axes = _of_arm("body/set_cf_orientation_absolute", "std_msgs/msg/Bool")
"""Whether wrenches of the tip are in the axes of the base; here never."""
tool_gravity = _of_arm("use_gravity_compensation", "std_msgs/msg/Bool")
"""Whether an arm bears its own weight; here always."""
tool_present = _of_arm("emulate_tool_present", "std_msgs/msg/Bool")
"""Whether a tool is on an arm; here always."""
tool_jaw_state = _of_arm("jaw/measured_js", "sensor_msgs/msg/JointState")
"""Measured angle of an arm's jaw."""
tool_jaw_setpoint = _of_arm("jaw/setpoint_js", "sensor_msgs/msg/JointState")
"""Current setpoint of an arm's jaw."""
master_gripper = _of_arm("gripper/measured_js", "sensor_msgs/msg/JointState")
"""Measured angle of the gripper of a master."""
tool_cut = _of_arm("cut", "sensor_msgs/msg/Joy")
"""Whether an arm's edge cuts."""


tool_joints = _of_arm("measured_js", "sensor_msgs/msg/JointState")
"""Measured positions, velocities and efforts of an arm's joints."""
tool_joint_setpoint = _of_arm("setpoint_js", "sensor_msgs/msg/JointState")
"""Current setpoint of an arm's joints."""
tool_joint_command = _of_arm("servo_jp", "sensor_msgs/msg/JointState")
"""Commanded positions of an arm's joints, reached at once."""
tool_joint_move = _of_arm("move_jp", "sensor_msgs/msg/JointState")
"""Goal to which an arm's joints move."""
tool_joint_change = _of_arm("servo_jr", "sensor_msgs/msg/JointState")
"""Commanded change of the positions of an arm's joints, made at once."""
tool_joint_move_change = _of_arm("move_jr", "sensor_msgs/msg/JointState")
"""Change of the goal to which an arm's joints move."""
tool_hold = _of_arm("hold", "std_msgs/msg/Empty")
"""Ends all moves of an arm where it is."""
tool_free = _of_arm("free", "std_msgs/msg/Empty")
"""Lets go of the position of an arm's joints, which nothing moves then."""
tool_ratio_command = _of_arm("trajectory_j/set_ratio", "std_msgs/msg/Float64")
"""Commanded part of their largest speeds with which an arm's moves go."""
tool_body_jacobian = _of_arm("body/jacobian", "std_msgs/msg/Float64MultiArray")
"""Jacobian of an arm in the axes of its tip."""
tool_spatial_jacobian = _of_arm("spatial/jacobian", "std_msgs/msg/Float64MultiArray")
"""Jacobian of an arm in its base, for what is at the base's origin."""
tool_velocity = _of_arm("measured_cv", "geometry_msgs/msg/TwistStamped")
"""Measured velocity of an arm's tip."""
tool_local_pose = _of_arm("local/measured_cp", "geometry_msgs/msg/PoseStamped")
"""Measured pose of an arm's tip in its base."""
tool_local_setpoint = _of_arm("local/setpoint_cp", "geometry_msgs/msg/PoseStamped")
"""Current setpoint of an arm's tip in its base."""
tool_links = _of_arm("link_poses", "geometry_msgs/msg/PoseArray")
"""Poses of the links of an arm's instrument."""
tool_ratio = _of_arm("trajectory_j/ratio", "std_msgs/msg/Float64", "latched")
"""Part of their largest speeds with which an arm's moves go."""
tool_type = _of_arm("tool_type", "std_msgs/msg/String", "latched")
"""Name and number, or path of the file, of the tool on an arm."""
tool_state = _of_arm("operating_state", "OperatingState", "latched")
"""CRTK operating state of an arm."""
tool_state_command = _of_arm("state_command", "StringStamped")
"""CRTK state command to an arm."""
tool_state_name = _of_arm("state", "StringStamped", "latched")
"""CRTK state of an arm by its name alone."""
tool_info = _of_arm("info", "StringStamped")
"""What an arm tells people."""
tool_warning = _of_arm("warning", "StringStamped")
"""What an arm warns people of."""
tool_error = _of_arm("error", "StringStamped")
"""What an arm refused, or what ended its move."""

policy_observation = _of_arm("observation", "sensor_msgs/msg/JointState")
"""What a policy that is a node of its own takes, by the name of the node."""
policy_image = _of_arm("image_raw", "sensor_msgs/msg/Image")
"""What it sees with the left eye."""
policy_right_image = _of_arm("right/image_raw", "sensor_msgs/msg/Image")
"""What it sees with the right eye."""
policy_action = _of_arm("action", "sensor_msgs/msg/JointState")
"""What it answers."""

JOINT_STATES = Topic("joint_states", "sensor_msgs/msg/JointState")
ROBOT_DESCRIPTION = Topic("robot_description", "std_msgs/msg/String", "latched")

RECORDING_TOPICS = (
    LEFT_IMAGE, LEFT_COMPRESSED, LEFT_INFO, RIGHT_IMAGE, RIGHT_COMPRESSED, RIGHT_INFO, DEPTH, MASK, CAMERA_POSE,
)  # fmt: skip
MODEL_TOPICS = (GAUSSIANS, TRAINING_CAMERAS, TRAINING_CAMERA_INFO)
TOOL_TOPICS = (  # of one arm; without those whose type is not installed everywhere
    tool_pose, tool_pose_command, tool_move, tool_setpoint, tool_wrench, tool_jaw, tool_jaw_move, tool_jaw_state, tool_jaw_setpoint,
    tool_cut, tool_reaction, tool_links, tool_type, tool_joints, tool_joint_setpoint, tool_joint_command, tool_joint_move, tool_velocity,
    tool_local_pose, tool_local_setpoint, tool_joint_change, tool_joint_move_change, tool_hold, tool_free, tool_ratio_command, tool_ratio,
    tool_body_jacobian, tool_spatial_jacobian, tool_spatial_wrench, tool_spatial_reaction, tool_jaw_effort,
    tool_joint_effort, tool_wrench_axes, tool_gravity, tool_present,
)  # fmt: skip
RENDERED_TOPICS = (RENDERED_INFO, RENDERED_POSE, RENDERED_DEPTH, RENDERED_IMAGE)


EXTRA_RENDERED_TOPICS = (RENDERED_COMPRESSED, RENDERED_SEGMENTATION, RENDERED_RIGHT_INFO, RENDERED_RIGHT_IMAGE, RENDERED_RIGHT_COMPRESSED)
"""What is rendered only for those who ask."""


def all_topics(arms: tuple[str, ...] = ("PSM1",)) -> tuple[Topic, ...]:
    """Every topic of the contract that can be recorded, for the given arms."""
    tools = tuple(make(arm) for arm in arms for make in TOOL_TOPICS)
    tissue = (CONTROL_NODES, CUT_SURFACE, DYE, STIFFNESS_MAP, TISSUE_MOTION, TISSUE_MOTION_COMMAND)
    scene = MODEL_TOPICS + (FOUND_MOTION,) + tissue + RENDERED_TOPICS + EXTRA_RENDERED_TOPICS + (THING_POSES, TASK_OUTCOME)
    found = RECORDING_TOPICS + scene + tools + (TOOL_MARKERS, JOINT_STATES, ROBOT_DESCRIPTION, DIAGNOSTICS, CLOCK)
    return tuple(dict.fromkeys(found))  # the pose of an ECM among the arms is that of the camera


def recorded_topics(arms: tuple[str, ...] = ("PSM1",), compressed: bool = True) -> tuple[Topic, ...]:
    """What a recorder of everything records: rendered images in one form, and nothing that would be rendered for it alone."""
    form = RENDERED_COMPRESSED if compressed else RENDERED_IMAGE
    others = {RENDERED_IMAGE, RENDERED_DEPTH, *EXTRA_RENDERED_TOPICS} - {form}
    return tuple(topic for topic in all_topics(arms) if topic not in others)
