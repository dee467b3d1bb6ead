"""ROS 2 node that keeps a robot's maps up to date with a channel of a Fleet Map Server and loads them.

Modules: ``node`` lifecycle node, the only module with rclpy · ``control`` agent process, hooks and levels ·
``loading`` calls of Nav2 and topological_navigation · ``grids`` map.yaml and PGM to cells · ``hook`` the agent's hook.
"""
