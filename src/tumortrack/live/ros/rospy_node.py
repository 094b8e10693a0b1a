"""ROS 1 topics through rospy: this process's one node, and its calls to the master.

rospy is made for a program that is nothing but a node: it has one node per process, waits for ever
for a master that is not there, and never registers again at a master that was restarted. So the
master is asked here first, with a time limit, and registrations are checked.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys
import threading
import time
import xmlrpc.client
from contextlib import suppress
from functools import cache
from http.client import HTTPConnection, HTTPException
from types import ModuleType
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from tumortrack.core.errors import InputError
from tumortrack.live.ros.bus import Publisher, Subscriber
from tumortrack.live.ros.messages import Messages
from tumortrack.live.ros.rospy_guard import guard_node, is_open
from tumortrack.live.values import SourceLost

_DEBIAN = "/usr/lib/python3/dist-packages"
_DEBIAN_PYTHON = "/usr/bin/python3"
_ANSWER_S = 1.0  # a master answers within milliseconds
_BUFFER = 2**21  # bytes taken from the socket at once: a cloud in one go
_SUCCESS = 1  # https://wiki.ros.org/ROS/Master_Slave_APIs
_ANY = "*"  # the type of a topic that so far is only subscribed to

_starting = threading.Lock()
_joined = ""  # the master at which this process is a node


class MasterLost(SourceLost):
    """The ROS master does not answer."""


def rospy_module() -> ModuleType:
    """rospy: as the ROS environment gives it, or else as Debian installs it: its folder goes to
    the end of ``sys.path``, so that what is installed here precedes Debian's older numpy. Raises
    InputError if there is none that this Python can import."""
    logger_class = logging.getLoggerClass()
    try:
        try:
            return importlib.import_module("rospy")
        except ImportError:
            _append_debian()
            return importlib.import_module("rospy")
    except ImportError as error:
        raise InputError(
            f"ROS 1 needs rospy, which cannot be imported ({error}). On Debian 12: apt install "
            "python3-rospy, and run tumortrack with Python 3.11; elsewhere source ROS's "
            "setup.bash, with a Python of the same version."
        ) from error
    finally:
        logging.setLoggerClass(logger_class)  # rospy's own is for rospy


def _append_debian() -> None:
    """Raises ImportError where Debian's packages are for another Python."""
    theirs = os.path.basename(os.path.realpath(_DEBIAN_PYTHON))
    ours = f"python{sys.version_info.major}.{sys.version_info.minor}"
    if not os.path.isdir(f"{_DEBIAN}/rospy"):
        raise ImportError(f"{_DEBIAN} has none")
    if theirs != ours:
        raise ImportError(f"Debian's is for {theirs}, and this is {ours}")
    if _DEBIAN not in sys.path:
        sys.path.append(_DEBIAN)


class Master(NamedTuple):
    """The ROS master's XML-RPC interface, with a time limit on every answer."""

    uri: str
    caller: str = "/tumortrack"

    def call(self, method: str, *arguments: object) -> Any:
        """The value of a call that the master granted; None of one that it refused. Raises
        MasterLost where there is no answer, or none that is XML-RPC."""
        try:
            proxy = xmlrpc.client.ServerProxy(self.uri, transport=_Hurried())
            code, _, value = getattr(proxy, method)(self.caller, *arguments)
        except (OSError, HTTPException, xmlrpc.client.Error, ValueError, TypeError) as error:
            raise MasterLost(
                f"the ROS master at {self.uri} does not answer ({error}). Start roscore, or set "
                "ROS_MASTER_URI to where it runs."
            ) from error
        return value if code == _SUCCESS else None

    def published_types(self) -> dict[str, str]:
        """Topics that somebody publishes, with their message types, where these are known."""
        publishers, *_ = self.call("getSystemState")
        published = {topic for topic, nodes in publishers if nodes}
        return {
            topic: kind.replace("/", "/msg/")
            for topic, kind in self.call("getTopicTypes") or []
            if topic in published and kind != _ANY
        }


class _Hurried(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = _ANSWER_S
        return connection


def _join() -> tuple[ModuleType, Master]:
    """rospy, its node started at the first call, and the master: one of each per process."""
    global _joined
    good = False
    with _starting:
        uri = os.environ.get("ROS_MASTER_URI") or "http://localhost:11311"
        with suppress(ValueError):
            parts = urlsplit(uri)
            good = parts.scheme == "http" and bool(parts.hostname) and parts.port is not None
        if not good:
            raise InputError(
                f"ROS_MASTER_URI is {uri!r}; it must look like http://localhost:11311."
            )
        if _joined not in ("", uri):
            raise InputError(
                f"ROS_MASTER_URI is now {uri}, and this program is already a node of "
                f"{_joined}. Start it anew for another master."
            )
        rospy = rospy_module()
        Master(uri).call("getPid")  # rospy would wait for it for ever
        if not rospy.core.is_initialized():
            guard_node(rospy, str(parts.hostname))
            _start(rospy)
        _joined = uri
        return rospy, Master(uri, rospy.get_name())


def _start(rospy: ModuleType) -> None:
    """rospy's start, without its grip on signals, arguments, the clock and logging."""
    configure = rospy.core.configure_logging
    rospy.core.configure_logging = lambda *_: None  # closes all log handlers; no option
    try:
        without = dict.fromkeys(("disable_signals", "disable_rostime", "disable_rosout"), True)
        rospy.init_node("tumortrack", argv=[], anonymous=True, **without)
    finally:
        rospy.core.configure_logging = configure
    # Its warnings go to whoever listens to Python's logging, and are not printed.
    for name in ("rosout", "rospy", "xmlrpc"):
        logging.getLogger(name).addHandler(logging.NullHandler())


class RospyBus:
    """This process's node, with the topics of one source or sink; see ``bus.Bus``. In ROS 1 each
    subscriber gets what is latched, whether asked for or not. Raises InputError without rospy, or
    if ROS_MASTER_URI is no address or changed since the start; MasterLost without an answer.
    """

    def __init__(self) -> None:
        self.messages = Messages("noetic")
        self.rospy, self.master = _join()
        self._arrived = threading.Condition()
        self._publishers: list[Any] = []  # rospy's
        self._handles: list[Any] = []  # those, and rospy's subscribers
        self._subscribers: list[RospySubscriber] = []
        self._closed = False
        self.note = "on this machine alone; for others set ROS_IP to this machine's address"
        if is_open(urlsplit(self.master.uri).hostname or ""):
            self.note = "anyone in this network can see the patient's organ, and stop this node"

    def publisher(self, topic: str, kind: str) -> Publisher:
        message_class = _raw_class(kind)
        handle = self.rospy.Publisher(topic, message_class, queue_size=1, tcp_nodelay=True)
        self._publishers.append(handle)
        self._handles.append(handle)

        def publish(raw: bytes | memoryview) -> None:
            message = message_class()
            message._buff = raw
            handle.publish(message)

        # rospy does not say what arrived.
        return Publisher(publish, time.sleep, lambda: handle.get_num_connections() > 0)

    def subscriber(self, topic: str, kind: str, most: int = 5, latched: bool = False) -> Subscriber:
        subscriber = RospySubscriber(topic, kind, most, self._arrived)
        any_type, sizes = self.rospy.AnyMsg, {"buff_size": _BUFFER, "tcp_nodelay": True}
        self._handles.append(self.rospy.Subscriber(topic, any_type, subscriber.came, **sizes))
        self._subscribers.append(subscriber)
        return subscriber

    def types_of(self, topic: str) -> set[str]:
        return {kind for name, kind in self.master.published_types().items() if name == topic}

    def wait(self, timeout_s: float) -> None:
        with self._arrived:
            self._arrived.wait_for(
                lambda: self._closed or any(one.pending for one in self._subscribers),
                max(timeout_s, 0.0),
            )

    def listens(self, topic: str) -> bool:
        """Whether the master knows that this node subscribes; a new master does not."""
        _, subscribers, _ = self.master.call("getSystemState")
        return self.master.caller in dict(subscribers).get(topic, ())

    def register_again(self) -> None:
        """Make the publishers known to a master that does not know them; subscribers stay
        connected."""
        known = dict(self.master.call("getSystemState")[0])
        for handle in self._publishers:
            name = handle.resolved_name
            if self.master.caller not in known.get(name, ()):
                address = self.rospy.get_node_uri()
                self.master.call("registerPublisher", name, handle.type, address)

    def close(self) -> None:
        with self._arrived:
            self._closed = True
            self._arrived.notify_all()
        while self._handles:
            self._handles.pop().unregister()


class RospySubscriber(Subscriber):
    """rospy's threads call ``came``."""

    def __init__(self, topic: str, kind: str, most: int, arrived: threading.Condition) -> None:
        super().__init__(most)
        self._topic, self._kind, self._arrived = topic, kind, arrived
        self._other = ""  # type of a message that came

    def came(self, message: Any) -> None:
        kind = message._connection_header["type"].replace("/", "/msg/")
        with self._arrived:
            super().came(message._buff)
            self._other = self._other if kind == self._kind else kind
            self._arrived.notify_all()

    def take(self) -> list[bytes | memoryview]:
        with self._arrived:
            taken, other, self._other = super().take(), self._other, ""
        if other:
            raise InputError(f"on {self._topic} came a {other}; it must be {self._kind}.")
        return taken


@cache
def _raw_class(message_type: str) -> Any:
    """A message class that carries bytes already serialised, as ``rospy.AnyMsg`` does, but may
    be published under its type's name."""
    text, md5sum = Messages("noetic").definition(message_type)
    name = message_type.replace("/msg/", "/")
    content = {"_type": name, "_md5sum": md5sum, "_full_text": text}
    return type(name.replace("/", "_"), (rospy_module().AnyMsg,), content)
