"""Zenoh: publish the events of the store's outbox, answer queries, receive robot status.

Modules: ``messages`` keys and payloads · ``bus`` Zenoh session with publishers, queryables and subscribers · ``router``
process of the embedded router · ``security`` and ``credentials`` TLS and users · ``relay`` outbox to bus, in order, at
least once · ``leader`` thread of one elected process · ``ros2``, ``ros_names`` and ``cdr`` ROS 2 topics.
"""
