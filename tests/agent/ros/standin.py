"""A stand-in of rclpy and the message packages: as much of their interface as the node uses, in one process."""

from __future__ import annotations

import sys
import threading
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any


class Message:
    """A message or request: any members."""

    def __init__(self, **members: Any) -> None:
        self.__dict__.update(members)


class OccupancyGrid:
    def __init__(self) -> None:
        pose = SimpleNamespace(position=SimpleNamespace(x=0.0, y=0.0, z=0.0), orientation=SimpleNamespace(z=0.0, w=1.0))
        self.header = SimpleNamespace(frame_id="", stamp=None)
        self.info = SimpleNamespace(map_load_time=None, resolution=0.0, width=0, height=0, origin=pose)
        self.data: Any = None


class Graph:
    """What all nodes share: services by name, and the last message of each topic."""

    def __init__(self) -> None:
        self.services: dict[str, Callable[[Any], Any]] = {}
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.latched: dict[str, list[Any]] = {}
        self.parameters: dict[str, Any] = {}
        self.log: list[tuple[str, str]] = []


class Future:
    def __init__(self) -> None:
        self._answer: Any = None
        self._error: Exception | None = None

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        self._callback = callback
        if self._answer is not None or self._error is not None:
            callback(self)

    def finish(self, answer: Any, error: Exception | None) -> None:
        self._answer, self._error = answer, error
        if hasattr(self, "_callback"):
            self._callback(self)

    def exception(self) -> Exception | None:
        return self._error

    def result(self) -> Any:
        return self._answer


class Client:
    def __init__(self, graph: Graph, name: str) -> None:
        self._graph, self._name = graph, name

    def wait_for_service(self, timeout_sec: float) -> bool:
        assert timeout_sec > 0
        return self._name in self._graph.services

    def call_async(self, request: Any) -> Future:
        self._graph.calls.append((self._name, dict(vars(request))))
        future, service = Future(), self._graph.services[self._name]

        def answer() -> None:
            try:
                response = service(request)
            except ArithmeticError as error:
                future.finish(None, error)
            else:
                if response is not None:
                    future.finish(response, None)

        threading.Thread(target=answer, daemon=True).start()
        return future

    def remove_pending_request(self, future: Future) -> None:
        pass


class LifecycleNode:
    graph = Graph()

    def __init__(self, name: str, **more: Any) -> None:
        self.name, self.graph = name, type(self).graph
        self._parameters: dict[str, Any] = {}
        self.entities: list[Any] = []
        self.offered: dict[str, Callable[[Any, Any], Any]] = {}

    def declare_parameter(self, name: str, value: Any) -> None:
        assert value != [], "rclpy takes an empty list for an array of bytes"
        assert isinstance(value, (bool, float, str, list)), name
        self._parameters[name] = self.graph.parameters.get(name, value)

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(value=self.graph.parameters.get(name, self._parameters[name]))

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        assert qos.durability == "transient_local"
        topic = topic.replace("~", f"/{self.name}")
        publisher = SimpleNamespace(publish=lambda message: self.graph.latched.setdefault(topic, []).append(message))
        self.entities.append(publisher)
        return publisher

    def create_subscription(self, kind: Any, topic: str, callback: Any, qos: Any, *, callback_group: Any) -> Any:
        subscription = SimpleNamespace(topic=topic)
        self.entities.append(subscription)
        for message in self.graph.latched.get(topic, ()):
            threading.Thread(target=callback, args=(message,), daemon=True).start()
        return subscription

    def create_client(self, kind: Any, name: str, *, callback_group: Any) -> Any:
        client = Client(self.graph, name)
        self.entities.append(client)
        return client

    def create_service(self, kind: Any, name: str, callback: Any, *, callback_group: Any) -> Any:
        service = SimpleNamespace(name=name)
        self.offered[name] = callback
        self.entities.append(service)
        return service

    def destroy(self, entity: Any) -> None:
        self.entities.remove(entity)

    destroy_publisher = destroy_subscription = destroy_client = destroy_service = destroy

    def get_logger(self) -> Any:
        def log(severity: str) -> Callable[[str], None]:
            return lambda text: self.graph.log.append((severity, text))

        return SimpleNamespace(info=log("info"), warning=log("warn"), error=log("error"))

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))

    def on_activate(self, state: Any) -> Any:
        return "success"

    def on_deactivate(self, state: Any) -> Any:
        return "success"


def modules() -> dict[str, types.ModuleType]:
    def module(name: str, **members: Any) -> tuple[str, types.ModuleType]:
        new_module = types.ModuleType(name)
        new_module.__dict__.update(members)
        return name, new_module

    def request(name: str) -> Any:
        return SimpleNamespace(__name__=name, Request=Message)

    constants: Mapping[str, Any] = {
        "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="transient_local"),
        "ReliabilityPolicy": SimpleNamespace(RELIABLE="reliable"),
        "HistoryPolicy": SimpleNamespace(KEEP_LAST="keep_last"),
    }
    codes = SimpleNamespace(SUCCESS="success", FAILURE="failure", ERROR="error")
    return dict(
        [
            module("rclpy"),
            module("rclpy.callback_groups", ReentrantCallbackGroup=object),
            module("rclpy.executors", MultiThreadedExecutor=object, ExternalShutdownException=Exception),
            module("rclpy.lifecycle", LifecycleNode=LifecycleNode, State=object, TransitionCallbackReturn=codes),
            module("rclpy.qos", QoSProfile=lambda **members: SimpleNamespace(**members), **constants),
            module("nav_msgs"),
            module("nav_msgs.msg", OccupancyGrid=OccupancyGrid),
            module("std_msgs"),
            module("std_msgs.msg", String=Message),
            module("std_srvs"),
            module("std_srvs.srv", Trigger=request("Trigger")),
            module("nav2_msgs"),
            module("nav2_msgs.srv", LoadMap=request("LoadMap"), DynamicEdges=request("DynamicEdges")),
            module("topological_navigation_msgs"),
            module("topological_navigation_msgs.srv", WriteTopologicalMap=request("WriteTopologicalMap")),
        ]
    )


@contextmanager
def ros() -> Iterator[Graph]:
    """ROS 2 as far as this process sees it."""
    before = dict(sys.modules)
    sys.modules.update(modules())
    LifecycleNode.graph = Graph()
    try:
        yield LifecycleNode.graph
    finally:
        for name in set(sys.modules) - set(before):
            if name.partition(".")[0] in {n.partition(".")[0] for n in modules()} or name.endswith("fleetmap_ros.node"):
                del sys.modules[name]
