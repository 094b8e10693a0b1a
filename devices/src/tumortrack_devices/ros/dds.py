"""ROS 2 topics without ROS: CDR bytes over Cyclone DDS, named and typed as ROS 2 does it.

A topic /a/b is ``rt/a/b`` on the wire, its type ``pkg::msg::dds_::Name_``, its encoding XCDR1,
and the endpoint's user data holds the type's hash (https://design.ros2.org/articles/
topic_and_service_names.html, REP 2011, REP 2016).
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
import time
import weakref
from functools import cache
from typing import Any

from cyclonedds import core, pub, sub
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack_devices.ros.bus import Publish, Subscriber
from tumortrack_devices.ros.messages import Messages

# A writer waits while more than WhcHigh is unacknowledged. One cloud exceeds the default of 500 kB:
# beside a reliable subscriber that hangs, one call in twenty took 25 ms instead of 2. Only the
# newest message is kept, so this limit is never reached. The receive buffer holds a few clouds; the
# kernel caps it at net.core.rmem_max. Without multicast, programs with another vendor's DDS that
# start later are found by announcements only: each second, not every 8.
_TUNING = (
    "<CycloneDDS><Domain><Internal><Watermarks><WhcHigh>64MB</WhcHigh></Watermarks>"
    '<SocketReceiveBufferSize max="16MB"/></Internal>'
    "<Discovery><SPDPInterval>1s</SPDPInterval></Discovery></Domain></CycloneDDS>"
)
# As rmw_cyclonedds does for the discovery range LOCALHOST, and bound to the loopback interface, as
# it does for ROS_LOCALHOST_ONLY.
_LOCAL = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces>"
    '<NetworkInterface address="127.0.0.1"/></Interfaces></General><Discovery>'
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32"
    '</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>'
    "</Discovery></Domain></CycloneDDS>"
)
_BLOCKED_NS = 20_000_000  # how long a writer may wait for a slow subscriber
_MOST_ENDPOINTS = 4096
_LARGEST_DOMAIN = 232  # further ones have ports beyond 65535 (DDSI-RTPS 9.6.1.1)
_OTHER_TYPES: dict[str, Any] = {  # that have other names in cyclonedds than in ROS
    **{"string": str, "bool": bool},
    **dict.fromkeys(("char", "byte", "octet"), types.uint8),
}

# A domain is set up once per process, with one participant, one reader of what is published, and
# one topic of each name and type. None of it is ever released: making a domain again would cut off
# its other users, and Cyclone (11.0.1) searches all types without a lock while it makes a topic, so
# that a program that left the graph and joined it again could crash.
_domains: dict[int, tuple[Any, DomainParticipant, BuiltinDataReader]] = {}
_topics: dict[tuple[int, str, str], Any] = {}
_setting_up = threading.Lock()


class DdsBus:
    """See ``bus.Bus``; in the environment's domain. ``CYCLONEDDS_URI``, ``ROS_LOCALHOST_ONLY`` and
    ``ROS_AUTOMATIC_DISCOVERY_RANGE`` choose the network. Raises InputError if the environment or
    the network cannot be used."""

    def __init__(self, messages: Messages) -> None:
        self.messages, self._domain = messages, domain_id()
        try:
            self._member, self._published = _join(self._domain)
            self._waitset, self._over = (
                core.WaitSet(self._member),
                core.GuardCondition(self._member),
            )
            self._waitset.attach(self._over)  # with nothing attached it would not wait
        except core.DDSException as error:
            raise InputError(
                f"DDS domain {self._domain} cannot be joined ({_error_text(error)}; Cyclone "
                "DDS says more above). Check the network, CYCLONEDDS_URI, and that not too many "
                "programs are in that domain."
            ) from error
        # Whatever nobody refers to is deleted, as cyclonedds has it: these are the only references.
        self._writers: list[Any] = []
        self._conditions: list[core.ReadCondition] = []
        self.note = (
            "on this machine alone"
            if _stays_here()
            else "anyone in this network can see the patient's organ, and publish under these "
            "names; ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST keeps it on this machine"
        )

    def publisher(self, topic: str, kind: str, latched: bool = False) -> Publish:
        durability, wire = Policy.Durability, _wire_type(kind)
        kept = durability.TransientLocal if latched else durability.Volatile
        reliable = Policy.Reliability.Reliable(_BLOCKED_NS)
        made: Any = pub.DataWriter(self._member, *self._endpoint(topic, kind, reliable, kept, 1))
        self._writers.append(made)
        known = weakref.ref(made)

        def publish(raw: bytes | memoryview) -> None:
            """Fails if subscribers don't keep up, or the bytes are not of the topic's type."""
            try:
                if (writer := known()) is not None:
                    writer.write(wire.deserialize(bytes(raw)))
            except core.DDSException as error:
                raise TumortrackError(
                    f"{topic}: a message of {len(raw)} bytes was not sent ({_error_text(error)})."
                ) from error

        return publish

    def subscriber(self, topic: str, kind: str, most: int = 5, latched: bool = False) -> Subscriber:
        # Best effort and volatile match every publisher; what was published before comes only to
        # reliable, transient local subscribers.
        qos: tuple[Any, Any] = (Policy.Reliability.BestEffort, Policy.Durability.Volatile)
        if latched:
            qos = Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal
        reader: Any = sub.DataReader(self._member, *self._endpoint(topic, kind, *qos, most))
        mask = core.ViewState.Any | core.InstanceState.Any | core.SampleState.NotRead
        self._conditions.append(core.ReadCondition(reader, mask))
        self._waitset.attach(self._conditions[-1])
        return DdsSubscriber(self._conditions[-1], most)

    def topics(self) -> dict[str, set[str]]:
        mask = core.ViewState.Any | core.SampleState.Any | core.InstanceState.Alive
        alive = core.ReadCondition(self._published, mask)
        topics: dict[str, set[str]] = {}
        for endpoint in self._published.read(_MOST_ENDPOINTS, alive):
            if endpoint.topic_name.startswith("rt/"):
                kind = ros_name(endpoint.type_name) or endpoint.type_name
                topics.setdefault(endpoint.topic_name.removeprefix("rt"), set()).add(kind)
        return topics

    def wait(self, timeout_s: float) -> None:
        self._waitset.wait(max(0, int(timeout_s * 1e9)))

    def flush(self, timeout_s: float) -> None:
        until_s = time.monotonic() + timeout_s
        for writer in self._writers:
            with contextlib.suppress(AttributeError):  # which it raises on a timeout (11.0.1)
                writer.wait_for_acks(max(0, int((until_s - time.monotonic()) * 1e9)))

    def close(self) -> None:
        self._over.set(True)
        for condition in list(self._conditions):
            self._waitset.detach(condition)
        self._writers.clear()
        self._conditions.clear()

    def _endpoint(
        self, topic: str, kind: str, reliability: Any, durability: Any, most: int
    ) -> tuple[Any, Any]:
        """Topic and QoS of a reader or writer."""
        user_data = f"typehash={self.messages.store.hash_rihs01(kind)};".encode()
        encoding = Policy.DataRepresentation(use_cdrv0_representation=True)
        kept = Policy.History.KeepLast(most)
        qos = Qos(reliability, durability, kept, encoding, Policy.Userdata(user_data))
        return _topic(self._domain, topic, kind), qos


class DdsSubscriber:
    """Takes messages from Cyclone's own queue, of ``most``; once closed there are none."""

    def __init__(self, condition: core.ReadCondition, most: int) -> None:
        self.lost, self._most = 0, most
        self._condition = weakref.ref(condition)

    def take(self) -> list[bytes | memoryview]:
        if (condition := self._condition()) is None:
            return []
        # Polled: a listener would make the thread that empties the socket wait for the GIL.
        self.lost = int(condition.reader.get_sample_lost_status().total_count)
        # Of a writer that is gone there is a sample without a message.
        taken = condition.reader.take(self._most, condition)
        return [one.raw for one in taken if hasattr(one, "raw")]


def domain_id() -> int:
    """The ROS domain, from the environment; InputError unless it is a whole number in 0..232."""
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not (text.isdecimal() and text.isascii() and int(text) <= _LARGEST_DOMAIN):
        raise InputError(
            f"ROS_DOMAIN_ID is {text!r}; it must be a whole number in 0..{_LARGEST_DOMAIN}."
        )
    return int(text)


def _join(domain: int) -> tuple[DomainParticipant, BuiltinDataReader]:
    """This process's participant, and what it reads of others. Raises InputError where the
    environment forbids any."""
    if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "OFF":
        raise InputError(
            "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF: no topic would ever be found. Allowed here: "
            "LOCALHOST, SUBNET, SYSTEM_DEFAULT, or not set."
        )
    with _setting_up:
        if domain not in _domains:
            local = _LOCAL if _stays_here() else ""
            parts = (_TUNING, local, os.environ.get("CYCLONEDDS_URI", ""))
            made = Domain(domain, ",".join(filter(None, parts)))
            member = DomainParticipant(domain, Qos(Policy.Userdata(b"enclave=/;")))
            published = BuiltinDataReader(member, BuiltinTopicDcpsPublication)
            _domains[domain] = made, member, published
        return _domains[domain][1:]


def _topic(domain: int, topic: str, kind: str) -> Any:
    with _setting_up:
        key = domain, topic, kind
        if key not in _topics:
            _topics[key] = Topic(_domains[domain][1], "rt" + topic, _wire_type(kind))
        return _topics[key]


def _stays_here() -> bool:
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    return os.environ.get("ROS_LOCALHOST_ONLY") == "1" or reach == "LOCALHOST"


def _error_text(error: core.DDSException) -> str:
    _, text = error.error_message_mapping.get(error.code, ("", f"error {error.code}"))
    return text.strip(" .").lower()


def dds_name(message_type: str) -> str:
    """``sensor_msgs/msg/Image`` -> ``sensor_msgs::msg::dds_::Image_``."""
    package, kind, name = message_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(type_name: str) -> str:
    """The inverse of ``dds_name``; empty if the type is not from ROS."""
    parts = re.fullmatch(r"(\w+)::(\w+)::dds_::(\w+)_", type_name)
    return "/".join(parts.groups()) if parts else ""


@cache
def _wire_type(message_type: str) -> Any:
    """The type, of which an object is just the bytes of a message (``raw``): cyclonedds would make
    Python objects of them, 40,000 points at 17 Hz."""
    kind = _made(message_type)

    def holding(cls: Any, data: bytes) -> Any:
        one = object.__new__(cls)
        one.raw = data
        return one

    kind.serialize = lambda self, **_: self.raw
    kind.deserialize = kind.deserialize_key = classmethod(holding)
    return kind


@cache
def idl_type(message_type: str) -> Any:
    """The type as a cyclonedds ``IdlStruct``: final, without a key, as ROS 2 makes it. Cyclone
    validates bytes from the network by it, lengths included."""
    return _made(message_type)


def _made(message_type: str) -> Any:
    _, fields = Messages().store.fielddefs[message_type]
    members = {name: _member(kind) for name, kind in fields}
    name = message_type.rsplit("/", 1)[-1]
    return make_idl_struct(f"{name}_", dds_name(message_type), members)


def _member(kind: Any) -> Any:
    node, content = kind
    if node == Nodetype.NAME:
        return idl_type(content)
    if node == Nodetype.BASE:
        return _OTHER_TYPES.get(content[0]) or getattr(types, content[0])
    inner, length = content
    if node == Nodetype.ARRAY:
        return types.array(_member(inner), length)
    return types.sequence(_member(inner))
