"""The graph on a system ROS 2: ros2 launch endo_sim_ros endo_sim.launch.py [bag:=PATH] [params:=FILE]"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node

from launch import LaunchDescription

CONFIG = Path(__file__).parent.parent / "config"


def generate_launch_description() -> LaunchDescription:
    bag, params = LaunchConfiguration("bag"), LaunchConfiguration("params")
    nodes = [
        Node(package="endo_sim_ros", executable=name, name=name, parameters=[params], output="screen")
        for name in ("reconstruction_node", "physics_node", "rendering_node")
    ]
    player = Node(
        package="endo_sim_ros",
        executable="bag_player_node",
        parameters=[{"bag": bag}],
        output="screen",
        condition=IfCondition(PythonExpression(["'", bag, "' != ''"])),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", default_value="", description="Recording to replay; empty for a live endoscope."),
            DeclareLaunchArgument(
                "params", default_value=str(CONFIG / "endo_sim.yaml"), description="Parameter file of the nodes."
            ),
            *nodes,
            player,
        ]
    )
