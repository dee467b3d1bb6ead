"""A ROS 2 node that keeps a robot's maps at a Fleet Map Server's channel and loads them.

``node`` the lifecycle node, the only module with rclpy · ``control`` the agent's process, hooks and levels ·
``loading`` calls of Nav2 and topological_navigation · ``grids`` map.yaml and PGM as cells · ``hook`` what the agent
runs after a switch.
"""
