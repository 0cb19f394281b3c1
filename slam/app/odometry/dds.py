"""ROS 2 without an installation: its topics and messages, through Cyclone DDS.

A topic `/odom` of ROS 2 is `rt/odom` in DDS, its type `nav_msgs/msg/Odometry` is
`nav_msgs::msg::dds_::Odometry_`. Messages come and go as CDR bytes. ROS 2 and this program find
each other if their domains are equal (ROS_DOMAIN_ID, 0 by default) and multicast reaches; which
network interfaces are used, CYCLONEDDS_URI says.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple, TypeAlias

from cyclonedds import builtin, core, domain, idl, pub, sub, topic, util
from cyclonedds.core import DDSException, Policy
from cyclonedds.idl import types
from rosbags.interfaces import Nodetype

from slam.app.errors import UsageError
from slam.live.errors import AppError
from slam.live.session import cdr
from xethru_protocol.recordings.mcap import FLOAT_ARRAY
from xethru_protocol.validation import shown

TYPE_HASHES = {
    FLOAT_ARRAY: "0599f6f85b4bfca379873a0b4375a0aca022156bd2d7021275d116ed1fa8bfe0",
    cdr.MARKERS: "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
    cdr.ODOMETRY: "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    cdr.PATH: "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
    cdr.POSE_WITH_COVARIANCE: "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    cdr.TRANSFORMS: "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
"""SHA-256 of descriptions of types by REP 2016, which ROS 2 from Iron on looks for.

Source: ros2-pyterfaces 0.3; they are the same from Humble to Kilted.
"""

_BASE_TYPES = {
    "bool": bool,
    "string": str,
    **{kind: getattr(types, kind) for kind in ("float32", "float64", "int32", "uint8", "uint32")},
}
_TYPE_NAME = re.compile(r"(\w+)::msg::dds_::(\w+)_")
_MOST_DOMAIN = 232
_MOST_ENDPOINTS = 10_000
_KEPT = 200
"""Messages that wait for a reader: seconds of odometry."""
_LONGEST_WRITE = util.duration(milliseconds=100)

Idl: TypeAlias = Any  # Cyclone's types are made at run time


def _from_bytes(cls: Idl, data: bytes, /, **_: object) -> Idl:
    message = cls.__new__(cls)
    message.packed = bytes(data)
    return message


@cache
def idl_type(message_type: str) -> Idl:
    """Return Cyclone's type of a message, such as `nav_msgs/msg/Odometry`, as rosbags defines it.

    Cyclone's writers and readers of it handle bytes; its `__idl__` packs and reads fields.
    """

    def of(kind: Nodetype, value: Any) -> Idl:  # noqa: ANN401 - nested definitions of rosbags
        if kind == Nodetype.BASE:
            return _BASE_TYPES[value[0]]
        if kind == Nodetype.NAME:
            return idl_type(value)
        inner, size = of(*value[0]), value[1]
        return types.array[inner, size] if kind == Nodetype.ARRAY else types.sequence[inner]

    package, _, name = message_type.split("/")
    fields = {field: of(*kind) for field, kind in cdr.typestore().fielddefs[message_type][1]}
    made: Idl = idl.make_idl_struct(f"{name}_", f"{package}::msg::dds_::{name}_", fields)
    # not in a base class: Cyclone takes those for parts of the type
    made.serialize = lambda message, **_: message.packed
    made.deserialize = classmethod(_from_bytes)
    return made


def domain_number() -> int:
    """Return the ROS domain by the environment; UsageError if that makes no sense."""
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not re.fullmatch("[0-9]{1,3}", text) or int(text) > _MOST_DOMAIN:
        raise UsageError(f"ROS_DOMAIN_ID is {shown(text)}; must be 0 to {_MOST_DOMAIN}")
    return int(text)


class Offer(NamedTuple):
    """A publisher in a ROS domain; `message_type` is written as `std_msgs/msg/Empty`."""

    topic: str
    message_type: str
    is_reliable: bool


class Ros2Domain:
    """The topics of the ROS domain of the environment; its methods raise AppError."""

    def __init__(self) -> None:
        with _naming("cannot begin; look at CYCLONEDDS_URI and the network interfaces"):
            self._participant = domain.DomainParticipant(domain_number())
            publications = builtin.BuiltinTopicDcpsPublication
            self._publications = builtin.BuiltinDataReader(self._participant, publications)
            self._alive = _condition(self._publications, core.InstanceState.Alive)

    def offers(self) -> list[Offer]:
        """Return the publishers known by now, also those of this program."""
        with _naming("cannot list topics"):
            endpoints = self._publications.read(_MOST_ENDPOINTS, condition=self._alive)
        return [
            Offer(
                topic=one.topic_name.removeprefix("rt"),
                message_type=f"{kind[1]}/msg/{kind[2]}",
                is_reliable=any(isinstance(each, Policy.Reliability.Reliable) for each in one.qos),
            )
            for one in endpoints
            if one.topic_name.startswith("rt/") and (kind := _TYPE_NAME.fullmatch(one.type_name))
        ]

    def writer(
        self, name: str, message_type: str, *, latched: bool = False
    ) -> Callable[[bytes], None]:
        """Return what publishes messages in CDR on a topic; AppError if a subscriber blocks it.

        It is reliable; of a latched topic who comes later gets the last message.
        """
        qos = core.Qos(
            Policy.Reliability.Reliable(_LONGEST_WRITE),
            Policy.History.KeepLast(1 if latched else 10),
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.Userdata(f"typehash=RIHS01_{TYPE_HASHES[message_type]};".encode()),
        )
        kind = idl_type(message_type)
        with _naming(f"cannot publish {name}"):
            writer = pub.DataWriter(self._participant, self._topic(name, kind), qos=qos)

        def write(data: bytes) -> None:
            with _naming(f"cannot publish {name}; is a subscriber too slow?"):
                writer.write(kind.deserialize(data))

        return write

    def reader(
        self, name: str, message_type: str, *, reliable: bool
    ) -> Callable[[float], list[bytes]]:
        """Return what waits for messages on a topic, so many seconds, and returns them in CDR."""
        reliability = Policy.Reliability
        qos = core.Qos(
            reliability.Reliable(_LONGEST_WRITE) if reliable else reliability.BestEffort,
            Policy.History.KeepLast(_KEPT),
        )
        with _naming(f"cannot subscribe to {name}"):
            kind = self._topic(name, idl_type(message_type))
            reader = sub.DataReader(self._participant, kind, qos=qos)
            waits = core.WaitSet(self._participant)
            waits.attach(_condition(reader, core.InstanceState.Any))

        def take(wait_s: float) -> list[bytes]:
            with _naming(f"cannot read {name}"):
                waits.wait(util.duration(seconds=wait_s))
                # that a publisher is gone comes as a sample without message
                return [one.packed for one in reader.take(_KEPT) if hasattr(one, "packed")]

        return take

    def _topic(self, name: str, kind: Idl) -> Idl:
        return topic.Topic(self._participant, f"rt{name}", kind)


def _condition(reader: Idl, instances: int) -> Idl:
    return core.ReadCondition(reader, core.SampleState.Any | core.ViewState.Any | instances)


@contextmanager
def _naming(problem: str) -> Iterator[None]:
    try:
        yield
    except DDSException as error:
        raise AppError(f"ROS 2, domain {domain_number()}: {problem} ({error.code})") from None
