"""ROS 1 topics through rospy: this process's one node, and its calls to the master.

rospy is made for a program that is nothing but a node: it has one node per process, waits for ever
for a master that is not there, and never registers again at a master that was restarted. So the
master is asked here first, with a time limit, and registrations are checked.
"""

from __future__ import annotations

import importlib
import logging
import os
import re
import sys
import threading
import time
import xmlrpc.client
from collections import deque
from functools import cache
from http.client import HTTPConnection, HTTPException
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

from tumortrack.core.errors import InputError
from tumortrack.live.ros.messages import Messages
from tumortrack.live.values import SourceLost

_DEBIAN = "/usr/lib/python3/dist-packages"
_DEBIAN_PYTHON = "/usr/bin/python3"
_NAME = re.compile(r"[/~]?[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)
_ANSWER_S = 1.0  # a master answers within milliseconds
_BUFFER = 2**21  # bytes taken from the socket at once: a cloud in one go
_SUCCESS = 1  # https://wiki.ros.org/ROS/Master_Slave_APIs

_ANY = "*/msg/"  # the type of a topic that so far is only subscribed to

_starting = threading.Lock()
_node: Node | None = None


class MasterLost(SourceLost):
    """The ROS master does not answer."""


def rospy_module() -> ModuleType:
    """rospy: as the ROS environment gives it, or else as Debian installs it.

    Debian's folder goes to the end of ``sys.path``, so that whatever is installed here keeps
    precedence over Debian's older numpy.

    Raises:
        InputError: there is none that this Python can import.
    """
    logger_class = logging.getLoggerClass()
    try:
        try:
            return importlib.import_module("rospy")
        except ImportError:
            _append_debian()
            return importlib.import_module("rospy")
    except ImportError as error:
        raise InputError(_how_to_get(str(error))) from error
    finally:
        logging.setLoggerClass(logger_class)  # rospy's own is for rospy


def _append_debian() -> None:
    """Raises InputError where Debian's packages are for another Python."""
    theirs = os.path.basename(os.path.realpath(_DEBIAN_PYTHON))
    ours = f"python{sys.version_info.major}.{sys.version_info.minor}"
    if not os.path.isdir(os.path.join(_DEBIAN, "rospy")):
        raise InputError(_how_to_get(f"{_DEBIAN} has none"))
    if theirs != ours:
        raise InputError(_how_to_get(f"Debian's is for {theirs}, and this is {ours}"))
    if _DEBIAN not in sys.path:
        sys.path.append(_DEBIAN)


def check_name(name: str) -> None:
    """Raises InputError for what is no name of a topic (http://wiki.ros.org/Names)."""
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{name!r} is no ROS topic; names look like /camera/depth/points: letters, digits, _ "
            "and / between them."
        )


def full_type(ros1_type: str) -> str:
    """``sensor_msgs/Image`` -> ``sensor_msgs/msg/Image``."""
    package, _, name = ros1_type.partition("/")
    return f"{package}/msg/{name}"


def _how_to_get(why: str) -> str:
    return (
        f"ROS 1 needs rospy, which cannot be imported ({why}). On Debian 12: apt install "
        "python3-rospy, and run tumortrack with Python 3.11; elsewhere source ROS's setup.bash, "
        "with a Python of the same version."
    )


class Master:
    """The ROS master's XML-RPC interface, with a time limit on every answer."""

    def __init__(self, uri: str, caller: str = "/tumortrack") -> None:
        self.uri, self.caller = uri, caller

    def call(self, method: str, *arguments: object) -> Any:
        """The value of a call that the master granted; None of one that it refused.

        Raises:
            MasterLost: no answer, or none that is XML-RPC.
        """
        try:
            proxy = xmlrpc.client.ServerProxy(self.uri, transport=_Hurried())
            code, _, value = getattr(proxy, method)(self.caller, *arguments)
        except (OSError, HTTPException, xmlrpc.client.Error, ValueError, TypeError) as error:
            raise MasterLost(
                f"the ROS master at {self.uri} does not answer ({error}). Start roscore, or set "
                "ROS_MASTER_URI to where it runs."
            ) from error
        return value if code == _SUCCESS else None

    def published(self) -> set[str]:
        """Topics that somebody publishes."""
        publishers, *_ = self.call("getSystemState")
        return {topic for topic, nodes in publishers if nodes}

    def published_types(self) -> dict[str, str]:
        """Those topics with their message types, where these are known."""
        published, types = self.published(), self.call("getTopicTypes") or []
        known = {topic: full_type(kind) for topic, kind in types if topic in published}
        return {topic: kind for topic, kind in known.items() if kind != _ANY}

    def simulated_time(self) -> bool:
        """Stamps follow a simulation's or a recording's clock, and not the machines'."""
        return self.call("getParam", "/use_sim_time") is True


class _Hurried(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = _ANSWER_S
        return connection


class Node:
    """This process as a ROS 1 node; see ``node``."""

    def __init__(self, master_uri: str, rospy: ModuleType) -> None:
        self.rospy = rospy
        self.name: str = rospy.get_name()
        self.master = Master(master_uri, self.name)

    def resolved(self, topic: str) -> str:
        """The topic's full name in this node's namespace."""
        return self.rospy.resolve_name(topic)

    def listens(self, topic: str) -> bool:
        """Whether the master knows that this node subscribes; a new master does not."""
        _, subscribers, _ = self.master.call("getSystemState")
        return self.name in dict(subscribers).get(topic, ())


def node() -> Node:
    """The node, started at the first call; rospy knows one per process, and one master.

    Raises:
        InputError: no rospy; ROS_MASTER_URI is no address, or changed since the start.
        MasterLost: the master does not answer.
    """
    global _node
    with _starting:
        uri = _master_uri()
        if _node is not None and _node.master.uri != uri:
            raise InputError(
                f"ROS_MASTER_URI is now {uri}, and this program is already a node of "
                f"{_node.master.uri}. Start it anew for another master."
            )
        rospy = rospy_module()
        Master(uri).call("getPid")  # rospy would wait for it for ever
        if _node is None:
            if not rospy.core.is_initialized():
                _start(rospy)
            _node = Node(uri, rospy)
        return _node


def _master_uri() -> str:
    uri = os.environ.get("ROS_MASTER_URI") or "http://localhost:11311"
    try:
        parts = urlsplit(uri)
        good = parts.scheme == "http" and bool(parts.hostname) and parts.port is not None
    except ValueError:
        good = False
    if not good:
        raise InputError(f"ROS_MASTER_URI is {uri!r}; it must look like http://localhost:11311.")
    return uri


def _start(rospy: ModuleType) -> None:
    """rospy's start, without its grip on signals, arguments, the clock and logging."""
    configure = rospy.core.configure_logging
    rospy.core.configure_logging = lambda *_: None  # it would close everybody's log handlers
    try:
        rospy.init_node(
            "tumortrack",
            argv=[],
            anonymous=True,
            disable_signals=True,
            disable_rostime=True,
            disable_rosout=True,
        )
    finally:
        rospy.core.configure_logging = configure
    # Its warnings go to whoever listens to Python's logging, and are not printed.
    logging.getLogger("rosout").addHandler(logging.NullHandler())


class RospyBus:
    """This node's topics of one source or sink; see ``bus.Bus``.

    Raises:
        InputError, MasterLost: as ``node``.
    """

    def __init__(self, messages: Messages) -> None:
        self.node = node()
        self._messages = messages
        self._arrived = threading.Condition()
        self._publishers: list[RospyPublisher] = []
        self._subscribers: list[RospySubscriber] = []
        self._closed = False

    def publisher(self, topic: str, message_type: str) -> RospyPublisher:
        kind = _raw_class(
            message_type.replace("/msg/", "/"),
            self._messages.md5(message_type),
            self._messages.definition(message_type),
        )
        handle = self.node.rospy.Publisher(topic, kind, queue_size=1, tcp_nodelay=True)
        self._publishers.append(RospyPublisher(handle))
        return self._publishers[-1]

    def subscriber(
        self, topic: str, message_type: str, depth: int = 5, latched: bool = False
    ) -> RospySubscriber:
        """``latched`` makes no difference: in ROS 1 each subscriber gets what is latched."""
        rospy = self.node.rospy
        subscriber = RospySubscriber(topic, message_type, depth, self._arrived)
        subscriber.handle = rospy.Subscriber(
            topic, rospy.AnyMsg, subscriber.came, buff_size=_BUFFER, tcp_nodelay=True
        )
        self._subscribers.append(subscriber)
        return subscriber

    def types_of(self, topic: str) -> set[str]:
        known = self.node.master.published_types()
        return {known[topic]} if topic in known else set()

    def wait(self, timeout_s: float) -> None:
        with self._arrived:
            self._arrived.wait_for(
                lambda: self._closed or any(one.pending for one in self._subscribers),
                max(timeout_s, 0.0),
            )

    def register_again(self) -> None:
        """Make the publishers known to a master that does not know them; subscribers stay
        connected.

        Raises:
            MasterLost: no answer.
        """
        node = self.node
        known, *_ = node.master.call("getSystemState")
        known = dict(known)
        for handle in (one.handle for one in self._publishers):
            if node.name not in known.get(handle.resolved_name, ()):
                address = node.rospy.get_node_uri()
                node.master.call("registerPublisher", handle.resolved_name, handle.type, address)

    def close(self) -> None:
        with self._arrived:
            self._closed = True
            self._arrived.notify_all()
        while self._publishers or self._subscribers:
            (self._publishers or self._subscribers).pop().handle.unregister()


class RospyPublisher:
    """See ``bus.Publisher``."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle

    @property
    def wanted(self) -> bool:
        return self.handle.get_num_connections() > 0

    def publish(self, raw: bytes | memoryview) -> None:
        message = self.handle.data_class()
        message._buff = raw
        self.handle.publish(message)

    def flush(self, timeout_s: float) -> None:
        time.sleep(timeout_s)  # rospy does not say what arrived


class RospySubscriber:
    """See ``bus.Subscriber``; rospy's threads call ``came``."""

    handle: Any

    def __init__(
        self, topic: str, message_type: str, depth: int, arrived: threading.Condition
    ) -> None:
        self._topic, self._type, self._arrived = topic, message_type, arrived
        self.pending: deque[Any] = deque(maxlen=depth)
        self.lost = 0

    def came(self, message: Any) -> None:
        with self._arrived:
            self.lost += len(self.pending) == self.pending.maxlen
            self.pending.append(message)
            self._arrived.notify_all()

    def take(self) -> list[bytes | memoryview]:
        with self._arrived:
            taken = list(self.pending)
            self.pending.clear()
        for message in taken:
            kind = full_type(message._connection_header["type"])
            if kind != self._type:
                raise InputError(f"on {self._topic} came a {kind}; it must be {self._type}.")
        return [message._buff for message in taken]


@cache
def _raw_class(type_name: str, md5sum: str, definition: str) -> type:
    """A message class that carries bytes already serialised, as ``rospy.AnyMsg`` does, but may
    be published under its type's name."""
    base = rospy_module().AnyMsg
    name = type_name.replace("/", "_")
    return type(name, (base,), {"_type": type_name, "_md5sum": md5sum, "_full_text": definition})
