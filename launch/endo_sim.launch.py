"""The graph on a system ROS 2: ros2 launch endo_sim_ros endo_sim.launch.py [bag:=PATH] …; --show-args lists the rest."""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

CONFIG = Path(__file__).resolve().parent.parent / "config"

ARGUMENTS = {
    "bag": ("", "Recording to replay; empty for a live endoscope."),
    "rate": ("1.0", "Speed of the replay relative to the recording."),
    "loop": ("false", "Start the replay again at its end."),
    "model": ("", "PLY model to start with; latest = the newest one that was saved."),
    "params": (str(CONFIG / "endo_sim.yaml"), "Parameter file of the nodes."),
    "arms": ("", "Names of the tool arms with commas between, such as PSM1,PSM2; empty = as in the parameter file."),
    "namespace": ("", "Namespace of all nodes and topics (except /diagnostics)."),
    "enclaves": ("", "Parent of the nodes' security enclaves, such as /endo_sim; empty = none named."),
    "view": ("false", "Serve the page on which the tissue is seen and pulled with the mouse; its log says where."),
    "rviz": ("false", "Open RViz with the view of this package."),
}


def _actions(context: LaunchContext) -> list[Node]:
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    params = Path(given["params"]).expanduser()
    if not params.is_file():  # launch would only warn, and the nodes would run with something else than was asked for
        raise FileNotFoundError(f"params: there is no file {params}")

    def node(name: str, **parameters) -> Node:
        return Node(
            package="endo_sim_ros",
            executable=name,
            namespace=given["namespace"],
            parameters=[str(params), {key: value for key, value in parameters.items() if value}],
            ros_arguments=["--enclave", f"{given['enclaves'].rstrip('/')}/{name}"] if given["enclaves"] else [],
            output="screen",
            sigterm_timeout="15",  # seconds to end after Ctrl-C; a busy machine needs more than the usual 5
        )

    def wanted(name: str) -> bool:
        return given[name].lower() in ("true", "1")

    arms = [arm.strip() for arm in given["arms"].split(",") if arm.strip()]
    actions = []
    if wanted("rviz"):  # first: where it is not installed nothing must have been started
        arguments = ["-d", str(CONFIG / "endo_sim.rviz")]
        actions.append(Node(package="rviz2", executable="rviz2", namespace=given["namespace"], arguments=arguments))
    actions.append(node("reconstruction_node", model_file=given["model"]))
    actions.append(node("physics_node", arms=arms))
    actions.append(node("rendering_node", arms=arms))
    if wanted("view"):
        actions.append(node("viewer_node", arm="".join(arms[:1]), arms=arms))
    if given["bag"]:
        actions.append(node("bag_player_node", bag=given["bag"], rate=float(given["rate"]), loop=wanted("loop")))
    return actions


def generate_launch_description() -> LaunchDescription:
    declared = [DeclareLaunchArgument(name, default_value=default, description=text) for name, (default, text) in ARGUMENTS.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=_actions)])
