"""ros2 launch tumortrack_ros track.launch.py model:=CASE source:=ros2:/camera/... [rviz:=true]"""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

SHARE = get_package_share_directory("tumortrack_ros")
ARGUMENTS = {
    "model": "",
    "source": "ros2:/camera/camera/depth/image_rect_raw",
    "params": f"{SHARE}/config/params.yaml",
    "rviz": "false",
    "view": f"{SHARE}/rviz/tumortrack.rviz",
}


def generate_launch_description():
    """The node, with the parameters' file and over it what is given here; RViz if asked for."""
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    own = {name: ParameterValue(given[name], value_type=str) for name in ("model", "source")}
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=text) for name, text in ARGUMENTS.items()),
            Node(
                package="tumortrack_ros",
                executable="track",
                name="tumortrack",
                output="screen",
                parameters=[given["params"], own],
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", given["view"]],
                condition=IfCondition(given["rviz"]),
            ),
        ]
    )
