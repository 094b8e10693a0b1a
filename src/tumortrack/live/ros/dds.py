"""ROS 2 topics without ROS: CDR bytes over Cyclone DDS, named and typed as ROS 2 does it.

A topic /a/b is ``rt/a/b`` on the wire, its type ``pkg::msg::dds_::Name_``, its encoding XCDR1,
and the type's hash stands in the endpoint's user data (https://design.ros2.org/articles/
topic_and_service_names.html, REP 2011, REP 2016). cyclonedds' Python layer would take a sample
apart into Python objects, 40,000 points at 17 Hz; here bytes go straight to its C library.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading
from functools import cache
from typing import Any

import numpy as np

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.ros.messages import Messages

# A writer waits while more than WhcHigh is not acknowledged. One cloud is more than the default,
# 500 kB: beside a reliable subscriber that hangs, one call in twenty took 25 ms instead of 2. The
# newest message alone is kept, so the limit set here is never reached. The receive buffer holds a
# few clouds; the kernel cuts it to net.core.rmem_max. Where there is no multicast, programs with
# another maker's DDS that start later are found by announcements alone: each second, not every 8.
_TUNING = (
    "<CycloneDDS><Domain><Internal><Watermarks><WhcHigh>64MB</WhcHigh></Watermarks>"
    '<SocketReceiveBufferSize max="16MB"/></Internal>'
    "<Discovery><SPDPInterval>1s</SPDPInterval></Discovery></Domain></CycloneDDS>"
)
# As rmw_cyclonedds does it for the discovery range LOCALHOST; bound to the loopback interface
# besides, as its ROS_LOCALHOST_ONLY is.
_LOCAL = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces>"
    '<NetworkInterface address="127.0.0.1"/></Interfaces></General><Discovery>'
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32"
    '</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>'
    "</Discovery></Domain></CycloneDDS>"
)
_BLOCKED_NS = 20_000_000  # how long a writer may wait for a slow subscriber
_MOST_ENDPOINTS = 4096
_NUMBERS = (
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
    *("float32", "float64"),
)

# A domain is set up once per process and outlives its participants: made again, it would cut off
# whoever else uses it.
_domains: dict[int, Any] = {}
_setting_up = threading.Lock()


class DdsBus:
    """One participant in domain ``domain_id``; see ``bus.Bus``.

    The network is the one that ``CYCLONEDDS_URI`` says, ``ROS_LOCALHOST_ONLY`` and
    ``ROS_AUTOMATIC_DISCOVERY_RANGE`` are heeded.
    """

    def __init__(self, messages: Messages, domain_id: int) -> None:
        """
        Raises:
            InputError: no cyclonedds; no network that it can use.
        """
        try:
            from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
            from cyclonedds.core import DDSException, GuardCondition, WaitSet
            from cyclonedds.domain import DomainParticipant
            from cyclonedds.qos import Policy, Qos
        except ImportError as error:
            raise InputError(
                "ROS 2 without ROS needs the package cyclonedds: pip install 'tumortrack[live]'."
            ) from error
        self._messages = messages
        self._closing = threading.Lock()
        try:
            _set_up(domain_id)
            member = DomainParticipant(domain_id, Qos(Policy.Userdata(b"enclave=/;")))
            self._waitset, self._over = WaitSet(member), GuardCondition(member)
            self._waitset.attach(self._over)  # and without anything attached it would not wait
            self._published = BuiltinDataReader(member, BuiltinTopicDcpsPublication)
        except DDSException as error:
            raise InputError(
                f"DDS domain {domain_id} cannot be joined ({_error_text(error.code)}; Cyclone "
                "DDS says more above). Check the network, CYCLONEDDS_URI, and that not too many "
                "programs are in that domain."
            ) from error
        self._member: Any = member

    def publisher(self, topic: str, message_type: str) -> DdsPublisher:
        return DdsPublisher(
            self._member, self._topic(topic, message_type), self._hash(message_type)
        )

    def subscriber(
        self, topic: str, message_type: str, depth: int = 5, latched: bool = False
    ) -> DdsSubscriber:
        subscriber = DdsSubscriber(
            self._member, self._topic(topic, message_type), self._hash(message_type), depth, latched
        )
        self._waitset.attach(subscriber.condition)
        return subscriber

    def types_of(self, topic: str) -> set[str]:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

        mask = ViewState.Any | SampleState.Any | InstanceState.Alive
        alive = ReadCondition(self._published, mask)
        known = self._published.read(_MOST_ENDPOINTS, alive)
        here = [one for one in known if one.topic_name == "rt" + topic]
        return {ros_name(one.type_name) or one.type_name for one in here}

    def wait(self, timeout_s: float) -> None:
        from cyclonedds.core import DDSException

        # Closed meanwhile by another thread: nothing will come.
        with contextlib.suppress(DDSException):
            self._waitset.wait(max(0, int(timeout_s * 1e9)))

    def close(self) -> None:
        with self._closing:
            member, self._member = self._member, None
        if member is not None:
            self._over.set(True)
            member._delete(member._ref)  # and with it all that it made

    def _topic(self, topic: str, message_type: str) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._member, "rt" + topic, idl_type(message_type, self._messages.distro))

    def _hash(self, message_type: str) -> bytes:
        return f"typehash={self._messages.type_hash(message_type)};".encode()


class DdsPublisher:
    """See ``bus.Publisher``."""

    wanted = True

    def __init__(self, member: Any, topic: Any, user_data: bytes) -> None:
        from cyclonedds.internal import DDS
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.topic import Sample

        self._name = topic.name.removeprefix("rt")
        self._writer = DataWriter(
            member,
            topic,
            Qos(
                Policy.Reliability.Reliable(_BLOCKED_NS),
                Policy.Durability.Volatile,
                Policy.History.KeepLast(1),
                Policy.DataRepresentation(use_cdrv0_representation=True),
                Policy.Userdata(user_data),
            ),
        )
        self._sample = Sample
        # By ctypes, and not by the extension module: that one keeps Python's lock while it waits
        # for a slow subscriber.
        self._write = DDS._dll_handle.dds_write
        self._write.argtypes = [ctypes.c_int32, ctypes.POINTER(Sample)]
        self._write.restype = ctypes.c_int32

    def publish(self, raw: bytes | memoryview) -> None:
        """
        Raises:
            TumortrackError: not sent: subscribers don't keep up, or these bytes are not what the
                topic's type says.
        """
        padded = np.frombuffer(bytes(raw) + bytes(-len(raw) % 4), np.uint8)
        sample = self._sample(padded.ctypes.data, padded.nbytes)
        code = self._write(self._writer._ref, ctypes.byref(sample))
        if code < 0:
            raise TumortrackError(
                f"{self._name}: a message of {len(raw)} bytes was not sent ({_error_text(code)})."
            )

    def flush(self, timeout_s: float) -> None:
        # Not its public method: that one fails on a timeout (11.0.1).
        self._writer._wait_for_acks(self._writer._ref, int(timeout_s * 1e9))


class DdsSubscriber:
    """See ``bus.Subscriber``."""

    def __init__(
        self, member: Any, topic: Any, user_data: bytes, depth: int, latched: bool
    ) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader

        self._depth, self._lost = depth, 0
        # Best effort and volatile ask for the least, and so match every publisher; what was
        # published before comes only to who asks for it, reliably.
        reliability = Policy.Reliability.Reliable(0) if latched else Policy.Reliability.BestEffort
        durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
        self._reader = DataReader(
            member,
            topic,
            Qos(
                reliability,
                durability,
                Policy.History.KeepLast(depth),
                Policy.DataRepresentation(use_cdrv0_representation=True),
                Policy.Userdata(user_data),
            ),
        )
        self.condition = ReadCondition(
            self._reader, ViewState.Any | InstanceState.Any | SampleState.NotRead
        )

    def take(self) -> list[bytes | memoryview]:
        from cyclonedds._clayer import ddspy_take

        taken = ddspy_take(self._reader._ref, self.condition.mask, self._depth)
        if isinstance(taken, int):  # an error: closed meanwhile by another thread
            return []
        return [data for data, info in taken if info.valid_data]

    @property
    def lost(self) -> int:
        """Asked for, not reported to a listener: that would make the thread that empties the
        socket wait for Python's lock."""
        from cyclonedds.internal import DDS, dds_c_t

        status = dds_c_t.sample_lost_status()
        DDS._dll_handle.dds_get_sample_lost_status(self._reader._ref, ctypes.byref(status))
        self._lost = max(self._lost, int(status.total_count))  # once closed it would be 0
        return self._lost


def _set_up(domain_id: int) -> None:
    from cyclonedds.domain import Domain

    with _setting_up:
        if domain_id not in _domains:
            parts = (_TUNING, _LOCAL if _local_only() else "", os.environ.get("CYCLONEDDS_URI", ""))
            _domains[domain_id] = Domain(domain_id, ",".join(filter(None, parts)))


def _local_only() -> bool:
    """Whether the environment keeps ROS 2 on this machine, as its own nodes read it.

    Raises:
        InputError: it says that nothing shall be found.
    """
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    if reach == "OFF":
        raise InputError(
            "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF: no topic would ever be found. Allowed here: "
            "LOCALHOST, SUBNET, SYSTEM_DEFAULT, or not set."
        )
    return os.environ.get("ROS_LOCALHOST_ONLY") == "1" or reach == "LOCALHOST"


def _error_text(code: int) -> str:
    from cyclonedds.core import DDSException

    _, text = DDSException.error_message_mapping.get(code, ("", f"error {code}"))
    return text.strip(" .").lower()


def dds_name(message_type: str) -> str:
    """``sensor_msgs/msg/Image`` -> ``sensor_msgs::msg::dds_::Image_``."""
    package, kind, name = message_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(type_name: str) -> str:
    """The way back; empty for a type that is none of ROS."""
    parts = type_name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return ""
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


@cache
def idl_type(message_type: str, distro: str) -> Any:
    """The type as a cyclonedds ``IdlStruct``; final, no key, as ROS 2 makes it. By it Cyclone
    checks that bytes from the network are what their type says, lengths included.

    Raises:
        InputError: no such type in that distribution, or one with wide characters.
    """
    from cyclonedds.idl import make_idl_struct
    from rosbags.typesys import Stores, get_typestore

    fields = get_typestore(Stores[f"ROS2_{distro.upper()}"]).fielddefs.get(message_type)
    if fields is None:
        raise InputError(f"ROS 2 {distro} has no message type {message_type}.")
    members = {name: _member(kind, distro) for name, kind in fields[1]}
    name = message_type.rsplit("/", 1)[-1]
    return make_idl_struct(f"{name}_", dds_name(message_type), members)


def _member(kind: Any, distro: str) -> Any:
    from cyclonedds.idl import types
    from rosbags.interfaces import Nodetype

    node, content = kind
    if node == Nodetype.NAME:
        return idl_type(content, distro)
    if node == Nodetype.BASE:
        name = {"char": "uint8", "byte": "uint8", "octet": "uint8"}.get(content[0], content[0])
        if name in _NUMBERS:
            return getattr(types, name)
        if name in ("string", "bool"):
            return str if name == "string" else bool
        raise InputError(f"messages with fields of type {name} are not supported.")
    inner, length = content
    if node == Nodetype.ARRAY:
        return types.array(_member(inner, distro), length)
    return types.sequence(_member(inner, distro))
