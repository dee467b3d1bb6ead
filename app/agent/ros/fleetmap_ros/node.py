"""Lifecycle node ``fleetmap_agent``: parameters, publishers and service clients; the rest is in ``control``."""

from __future__ import annotations

import array
import contextlib
import dataclasses
import importlib
import json
import math
import queue
import threading
from collections.abc import Mapping
from typing import Any

import rclpy
from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from .control import AgentProcess, HookServer, Loader, Settings, SettingsError, initial_site, switch_level
from .grids import Grid
from .loading import SETTLE_SECONDS, WAIT_SECONDS, LoadError, Steps

LATCHED = QoSProfile(
    depth=1,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""QoS of latched topics, as in Nav2's map server: late subscribers get the last message."""


THREADS = 4
"""Number of executor threads: one waits in ``switch_level`` while others receive responses of Nav2's services."""


class RclpyRos:
    """Service calls and a latched topic with rclpy. Must be called outside the executor's threads."""

    def __init__(self, node: Any, call_seconds: float) -> None:
        self._node, self._call_seconds = node, call_seconds
        self._group = ReentrantCallbackGroup()
        self._clients: dict[tuple[str, str], Any] = {}

    def has_service(self, name: str, type: str) -> bool:
        """Whether a service is available; waits up to WAIT_SECONDS for its discovery."""
        return bool(self._client(name, type).wait_for_service(timeout_sec=WAIT_SECONDS))

    def call(self, name: str, type: str, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Call a service and return ``result`` or ``success`` of its response. Raises LoadError."""
        client = self._client(name, type)
        message = service_type(type).Request()
        for member, value in request.items():
            setattr(message, member, value)
        done = threading.Event()
        future = client.call_async(message)
        future.add_done_callback(lambda _: done.set())
        if not done.wait(self._call_seconds):
            client.remove_pending_request(future)
            raise LoadError(f"no response from {name} within {self._call_seconds:g} seconds (parameter call_seconds)")
        if future.exception() is not None:
            raise LoadError(f"{name} failed: {future.exception()}")
        answer = future.result()
        return {member: getattr(answer, member) for member in ("result", "success") if hasattr(answer, member)}

    def last_text(self, topic: str) -> str:
        """Read the newest message of a latched std_msgs/msg/String. Raises LoadError."""
        texts: queue.Queue[str] = queue.Queue()
        subscription = self._node.create_subscription(
            String, topic, lambda message: texts.put(message.data), LATCHED, callback_group=self._group
        )
        text: str | None = None
        try:
            with contextlib.suppress(queue.Empty):
                while True:
                    text = texts.get(timeout=self._call_seconds if text is None else SETTLE_SECONDS)
        finally:
            self._node.destroy_subscription(subscription)
        if text is None:
            raise LoadError(f"no message on {topic}: start the map manager, or set the parameter topological_topic")
        return text

    def close(self) -> None:
        """Destroy the clients."""
        for client in self._clients.values():
            self._node.destroy_client(client)
        self._clients.clear()

    def _client(self, name: str, type: str) -> Any:
        if (name, type) not in self._clients:
            self._clients[name, type] = self._node.create_client(service_type(type), name, callback_group=self._group)
        return self._clients[name, type]


def service_type(name: str) -> Any:
    """Return the class of a service type ``package/srv/Name``. Raises LoadError if it is not installed."""
    package, _, rest = name.partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.srv"), rest.rpartition("/")[2])
    except (ImportError, AttributeError):
        raise LoadError(f"service type {name} not found: install {package}, or a newer version of it") from None


class FleetmapAgent(LifecycleNode):
    """Lifecycle node. Configured: parameters are read. Active: the agent runs, maps are loaded and published."""

    def __init__(self, **more: Any) -> None:
        super().__init__("fleetmap_agent", **more)
        self._group = ReentrantCallbackGroup()
        for parameter in dataclasses.fields(Settings):
            default = parameter.default
            self.declare_parameter(parameter.name, list(default) or [""] if isinstance(default, tuple) else default)
        self._settings: Settings | None = None
        self._ros: RclpyRos | None = None
        self._hooks: HookServer | None = None
        self._agent: AgentProcess | None = None
        self._loader: Loader | None = None
        self._topics: dict[str, Any] = {}
        self._status: Any = None
        self._level_service: Any = None

    # --- transitions ---

    def on_configure(self, _state: State) -> TransitionCallbackReturn:
        """Read the parameters; create topics and services."""
        try:
            settings = self._read_settings()
        except SettingsError as error:
            self._log("error", str(error))
            return TransitionCallbackReturn.FAILURE
        self._settings = settings
        self._ros = RclpyRos(self, settings.call_seconds)
        self._loader = Loader(self._ros, settings, self._publish)
        self._status = self.create_publisher(String, "~/status", LATCHED)
        topics = {"map": settings.map_topic} if settings.publish_map else {}
        if settings.publish_masks:
            topics |= {"keepout": settings.keepout_topic, "speed": settings.speed_topic}
        self._topics = {kind: self.create_publisher(OccupancyGrid, topic, LATCHED) for kind, topic in topics.items()}
        self._level_service = self.create_service(
            Trigger, "~/switch_level", self._on_switch_level, callback_group=self._group
        )
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Publish the installed map and start the agent."""
        assert self._settings is not None
        assert self._loader is not None
        site = initial_site(self._settings)
        if site is not None and self._topics:
            self._loader.publish(site, Steps(self._report))
        self._hooks = HookServer(self._loader, self._log)
        self._agent = AgentProcess(self._settings, self._hooks.command, self._on_event, self._log)
        try:
            self._agent.start()
        except SettingsError as error:
            self._log("error", str(error))
            self._stop()
            return TransitionCallbackReturn.FAILURE
        return super().on_activate(state)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Stop the agent; published maps stay available."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, _state: State) -> TransitionCallbackReturn:
        """Destroy topics and services."""
        self._withdraw()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, _state: State) -> TransitionCallbackReturn:
        """Stop the agent; destroy topics and services."""
        self.stop()
        return TransitionCallbackReturn.SUCCESS

    def stop(self) -> None:
        """Stop everything, also if the process ends without a transition."""
        self._stop()
        self._withdraw()

    # --- internals ---

    def _read_settings(self) -> Settings:
        names = [parameter.name for parameter in dataclasses.fields(Settings)]
        return Settings.from_parameters({name: self.get_parameter(name).value for name in names})

    def _stop(self) -> None:
        if self._agent is not None:
            self._agent.stop()
            self._agent = None
        if self._hooks is not None:
            self._hooks.close()
            self._hooks = None

    def _withdraw(self) -> None:
        for publisher in (*self._topics.values(), self._status):
            if publisher is not None:
                self.destroy_publisher(publisher)
        self._topics, self._status = {}, None
        if self._level_service is not None:
            self.destroy_service(self._level_service)
            self._level_service = None
        if self._ros is not None:
            self._ros.close()
            self._ros = None
        self._loader = None

    def _on_switch_level(self, _request: Any, response: Any) -> Any:
        """Load the level of the parameter ``level``."""
        if self._settings is None or self._agent is None:
            response.success, response.message = False, "the node is not active"
        else:
            level = str(self.get_parameter("level").value).strip()
            response.success, response.message = switch_level(self._settings, level)
        self._log("info" if response.success else "warn", response.message)
        return response

    def _on_event(self, body: Mapping[str, Any]) -> None:
        status = self._status
        if status is not None:
            status.publish(String(data=json.dumps(body)))

    def _publish(self, kind: str, grid: Grid) -> None:
        assert self._settings is not None
        publisher = self._topics.get(kind)
        if publisher is not None:
            now = self.get_clock().now().to_msg()
            publisher.publish(grid_message(grid, self._settings.frame_id, now))

    def _report(self, step: str, result: str, detail: str) -> None:
        self._log("warn" if result == "failed" else "info", f"{step}: {result}: {detail}")

    def _log(self, severity: str, text: str) -> None:
        logger = self.get_logger()
        {"info": logger.info, "warn": logger.warning, "error": logger.error}[severity](text)


def grid_message(grid: Grid, frame_id: str, stamp: Any) -> Any:
    """Return a nav_msgs/msg/OccupancyGrid."""
    message = OccupancyGrid()
    message.header.frame_id = frame_id
    message.header.stamp = stamp
    message.info.map_load_time = stamp
    message.info.resolution = grid.resolution
    message.info.width, message.info.height = grid.width, grid.height
    x, y, yaw = grid.origin
    message.info.origin.position.x, message.info.origin.position.y = x, y
    message.info.origin.orientation.z, message.info.origin.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    message.data = array.array("b", grid.cells)
    return message


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = FleetmapAgent()
    executor = MultiThreadedExecutor(num_threads=THREADS)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.stop()
        executor.shutdown()
        node.destroy_node()
        if rclpy.ok():
            rclpy.shutdown()
