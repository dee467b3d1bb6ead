"""Launch the node ``fleetmap_agent``; with ``autostart`` configure and activate it."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.substitutions import FindPackageShare
from lifecycle_msgs.msg import Transition


def generate_launch_description() -> LaunchDescription:
    """Describe the launch: arguments ``params_file``, ``namespace`` and ``autostart``."""
    default = PathJoinSubstitution([FindPackageShare("fleetmap_ros"), "config", "fleetmap_agent.yaml"])
    autostart = IfCondition(LaunchConfiguration("autostart"))
    node = LifecycleNode(
        package="fleetmap_ros",
        executable="fleetmap_agent",
        name="fleetmap_agent",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file")],
        output="screen",
    )
    activate = ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=Transition.TRANSITION_ACTIVATE)
    configure = ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=Transition.TRANSITION_CONFIGURE)
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=default, description="YAML file with the parameters"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument("autostart", default_value="true", description="configure and activate the node"),
            node,
            RegisterEventHandler(
                OnStateTransition(
                    target_lifecycle_node=node, goal_state="inactive", start_state="configuring",
                    entities=[EmitEvent(event=activate)],
                ),
                condition=autostart,
            ),
            EmitEvent(event=configure, condition=autostart),
        ]
    )  # fmt: skip
