# SPDX-License-Identifier: Apache-2.0
"""
A simulated robot, its identifier and a gain tuner: ros2 launch ctsid demo.launch.py.

Attach a payload while it flies: ros2 param set /simulated_robot payload 0.5. Or let it happen by
itself: change_after:=15.0.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return what to start."""
    share = FindPackageShare('ctsid')
    arguments = [
        DeclareLaunchArgument(
            'params_file', default_value=PathJoinSubstitution([share, 'config', 'live_demo.yaml']),
            description='Parameter file of the identifier.'),
        DeclareLaunchArgument(
            'change_after', default_value='0.0',
            description='When a payload is attached by itself [s]; 0: never.'),
    ]
    identifier = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([share, 'launch', 'identifier.launch.py'])),
        launch_arguments={'params_file': LaunchConfiguration('params_file')}.items())
    robot = Node(
        package='ctsid', executable='simulated_robot', name='simulated_robot', output='screen',
        parameters=[{'change_after': ParameterValue(
            LaunchConfiguration('change_after'), value_type=float)}])
    tuner = Node(package='ctsid', executable='gain_tuner', name='gain_tuner', output='screen')
    return LaunchDescription([*arguments, identifier, tuner, robot])
