# SPDX-License-Identifier: Apache-2.0
"""
The identifier alone: ros2 launch ctsid identifier.launch.py params_file:=/path/to/params.yaml.

With autostart:=false it waits to be configured and activated (`ros2 lifecycle set /identifier
configure`). Its models appear on NAMESPACE/identifier/model.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Return what to start."""
    arguments = [
        DeclareLaunchArgument(
            'params_file', description='Parameter file; `ctsid init` writes one from a bag.'),
        DeclareLaunchArgument(
            'autostart', default_value='true',
            description='Whether it configures and activates itself.'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false',
            description='Whether time comes from /clock (simulation, ros2 bag play --clock).'),
        DeclareLaunchArgument('namespace', default_value='', description='Namespace of the node.'),
    ]
    identifier = LifecycleNode(
        package='ctsid', executable='identifier', name='identifier', output='screen',
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file'), {
            name: ParameterValue(LaunchConfiguration(name), value_type=bool)
            for name in ('autostart', 'use_sim_time')}])
    return LaunchDescription([*arguments, identifier])
