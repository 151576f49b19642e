"""Starts the controller in a controller manager that is at work already."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    """The spawner, with the parameters of config/controllers.yaml."""
    parameters = Path(get_package_share_directory("forcegp_controller"), "config", "controllers.yaml")
    words = ["forcegp_controller", "--param-file", str(parameters)]
    return LaunchDescription([Node(package="controller_manager", executable="spawner", arguments=words)])
