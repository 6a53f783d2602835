"""A recording into the whole graph: ros2 launch endo_sim_ros replay.launch.py bag:=PATH [rate:=0.5] [loop:=true] [rviz:=true]"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    graph = Path(__file__).resolve().with_name("endo_sim.launch.py")
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="Recording to replay."),  # no default: asked for when it is missing
            IncludeLaunchDescription(str(graph)),  # hears all arguments
        ]
    )
