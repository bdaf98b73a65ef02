"""Records for Foxglove, in a file or live: the published messages, and poses and fixes in Foxglove's own schemas, as JSON.

Foxglove's 3-D panel needs a flat world with z up. `local_enu` has axes east, north, up at the origin, the position of the
first state; `base_link` is the body with axes forward, left, up. Poses are exact at any distance from the origin.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta, Struct

from fusiond.config.schema import Config
from fusiond.config.sensor import INERTIAL
from fusiond.messages.codec import encode
from fusiond.messages.local_frame import ENU_FLU, LocalFrame
from fusiond.messages.types import (
    MESSAGES,
    EventMessage,
    HealthMessage,
    InnovationMessage,
    Message,
    SettledMessage,
    Severity,
    State,
    StateAtInstant,
    StateMessage,
)
from fusiond.units import SECOND

ROOT, BODY = "local_enu", "base_link"  # frames
TRAIL_POINTS, TRAIL_STEP_M = 300, 2.0  # how far back the trail goes
KNOWN = 3  # position_covariance_type
LEVELS: dict[Severity, int] = {"info": 2, "notice": 2, "warning": 3, "critical": 4}  # of foxglove.Log

Nine = Annotated[list[float], Meta(min_length=9, max_length=9)]


class Channel(NamedTuple):
    """A topic and the JSON Schema of its messages in Foxglove's dialect."""

    topic: str
    schema_name: str
    schema: bytes


class Record(NamedTuple):
    """A message on a topic."""

    topic: str
    publish_ns: int  # when it was published; the instant it is valid for is in the data
    data: bytes


# --- Foxglove's schemas


class Time(Struct, frozen=True):
    """An instant of Unix time."""

    sec: int
    nsec: int


class Vector3(Struct, frozen=True):
    """m, or m/s."""

    x: float
    y: float
    z: float


class Quaternion(Struct, frozen=True):
    """Of the rotation from the child's or body's axes to the parent's."""

    x: float
    y: float
    z: float
    w: float


class PoseOf(Struct, frozen=True):
    """Position and attitude."""

    position: Vector3
    orientation: Quaternion


class LocationFix(Struct, frozen=True):
    """A position on the map."""

    timestamp: Time
    frame_id: str
    latitude: Annotated[float, Meta(description="deg")]
    longitude: Annotated[float, Meta(description="deg")]
    altitude: Annotated[float, Meta(description="m")]
    position_covariance: Annotated[Nine, Meta(description="m^2, east, north, up, row by row")]
    position_covariance_type: Annotated[int, Meta(description="3: known")]
    heading: Annotated[float, Meta(description="rad, clockwise from north")]
    velocity: Annotated[Vector3, Meta(description="m/s, east, north, up")]


class PoseInFrame(Struct, frozen=True):
    """The body in the local frame."""

    timestamp: Time
    frame_id: str
    pose: PoseOf


class PosesInFrame(Struct, frozen=True):
    """Where the body was, in the local frame."""

    timestamp: Time
    frame_id: str
    poses: list[PoseOf]


class FrameTransform(Struct, frozen=True):
    """The child frame's position and attitude in the parent frame."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class Log(Struct, frozen=True):
    """An event."""

    timestamp: Time
    level: Annotated[int, Meta(description="2 information, 3 warning, 4 error")]
    message: str
    name: str
    file: str
    line: int


LOCATION, ORIGIN, POSE, TRAIL, TRANSFORM, LOG = (
    f"/fusiond/{name}" for name in ("location", "origin", "pose", "trail", "tf", "log")
)
FOXGLOVE: dict[str, type[Struct]] = {
    LOCATION: LocationFix, ORIGIN: LocationFix, POSE: PoseInFrame, TRAIL: PosesInFrame, TRANSFORM: FrameTransform, LOG: Log,
}  # fmt: skip
TOPICS: dict[type[Message], str] = {
    kind: f"/fusiond/{name}"
    for name, kind in MESSAGES.items()
    if kind in (StateMessage, SettledMessage, HealthMessage, InnovationMessage, EventMessage)
}
SHOWN = tuple(TOPICS)  # the kinds of messages that an outbox needs

_encode = msgspec.json.Encoder().encode


def innovations_topic(source: str) -> str:
    """The topic of a source's innovations. A slash replaces the dot, which would need quotes in message paths."""
    return f"{TOPICS[InnovationMessage]}/{source.replace('.', '/')}"


def judged_sources(config: Config) -> list[str]:
    """The sources that have innovations: all but the IMU."""
    return [name for name, source in sorted(config.streams().items()) if source.stream.model != INERTIAL]


def channels(config: Config) -> list[Channel]:
    """All topics."""
    found = [
        Channel(topic, name := f"foxglove.{kind.__name__}", readable_schema(kind, name)) for topic, kind in FOXGLOVE.items()
    ]
    for kind, topic in TOPICS.items():
        topics = [innovations_topic(source) for source in judged_sources(config)] if kind is InnovationMessage else [topic]
        name = f"fusiond.{kind.__name__}"
        schema = readable_schema(kind, name, config.sources())
        found += [Channel(topic, name, schema) for topic in topics]
    return found


def readable_schema(kind: type[Struct], title: str, sources: Iterable[str] = ()) -> bytes:
    """The JSON Schema of a type for Foxglove: an object at the top, no references, one type for each field (any may be
    null), arrays of one kind of item, and the fields of `sources` by name."""
    whole = msgspec.json.schema(kind)
    definitions = whole.pop("$defs")

    def plain(schema: dict[str, Any], name: str = "") -> dict[str, Any]:
        if "$ref" in schema:
            return plain({**definitions[schema["$ref"].rpartition("/")[2]], **_without(schema, "$ref")}, name)
        if "anyOf" in schema:
            (inner,) = (option for option in schema["anyOf"] if option != {"type": "null"})
            return plain({**_without(schema, "anyOf"), **inner}, name)
        schema = _without(schema, "default", "required", "title")
        if "enum" in schema:
            schema["type"] = "string"
        if schema.get("type") == "array":
            items = schema.pop("prefixItems", [schema["items"]])[0]
            schema["items"] = plain(items)
        if schema.get("type") == "object":
            inner = schema.pop("additionalProperties", {})
            named = dict.fromkeys(sources, inner) if name == "sources" and isinstance(inner, dict) else {}
            fields = {**schema.get("properties", {}), **named}
            schema["properties"] = {key: plain(field, key) for key, field in fields.items()}
        return schema

    return json.dumps({"title": title, **plain(whole)}, separators=(",", ":")).encode()


def _without(schema: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in schema.items() if key not in keys}


# --- Messages to records


class _Origin(NamedTuple):
    frame: LocalFrame
    state: State  # at its origin


class Converter:
    """Published messages to records for Foxglove. States are thinned to `rate_hz` (None: not thinned), but a change of mode
    or a reset is always shown."""

    def __init__(self, rate_hz: float | None = None) -> None:
        self._period_ns = SECOND / rate_hz if rate_hz else 1.0
        self._turns: dict[type[Message], tuple[object, ...]] = {}  # by kind: mode, resets and number of the last period
        self._origin: _Origin | None = None
        self._origin_second: int | None = None  # in which the origin was last published
        self._trail: deque[tuple[float, float, float]] = deque(maxlen=TRAIL_POINTS)
        self._published_ns: int | None = None  # when the latest message was published

    def records(self, message: Message) -> Iterator[Record]:
        """The records of a message; none if a state is not due."""
        if not isinstance(message, StateAtInstant | HealthMessage | InnovationMessage | EventMessage):
            return
        if isinstance(message, StateAtInstant) and not self._is_due(message):
            return
        if not isinstance(message, SettledMessage | InnovationMessage):  # these are of an instant before their publication
            self._published_ns = message.t_ns
        publish_ns = self._published_ns or message.t_ns
        topic = innovations_topic(message.source) if isinstance(message, InnovationMessage) else TOPICS[type(message)]
        yield Record(topic, publish_ns, encode(message, "json"))
        if isinstance(message, EventMessage):
            log = Log(_time(message.t_ns), LEVELS[message.severity], message.text, message.vehicle, "", 0)
            yield Record(LOG, publish_ns, _encode(log))
        elif isinstance(message, StateMessage) and message.state is not None:
            for topic, shown in self._shown(message.t_ns, message.state):
                yield Record(topic, publish_ns, _encode(shown))

    def _is_due(self, message: StateAtInstant) -> bool:
        turn = message.mode, message.resets, message.t_ns // self._period_ns
        last, self._turns[type(message)] = self._turns.get(type(message)), turn
        return turn != last

    def _shown(self, t_ns: int, state: State) -> Iterator[tuple[str, Struct]]:
        time = _time(t_ns)
        if self._origin is None:
            self._origin = _Origin(LocalFrame.at(state, ENU_FLU), state)
        frame, origin = self._origin.frame, self._origin.state
        local = frame.state(state)
        w, x, y, z = local.quaternion_lb
        position, attitude = Vector3(*local.position_l), Quaternion(x, y, z, w)
        if not self._trail or math.dist(self._trail[-1], local.position_l) >= TRAIL_STEP_M:
            self._trail.append(local.position_l)
        if self._origin_second != time.sec:  # once a second, for clients that connect later
            self._origin_second = time.sec
            fix = _fix(time, ROOT, origin, frame)
            yield ORIGIN, msgspec.structs.replace(fix, heading=0.0, velocity=Vector3(0.0, 0.0, 0.0))
            places = [Vector3(*(round(number, 2) for number in place)) for place in (*self._trail, local.position_l)]
            yield TRAIL, PosesInFrame(time, ROOT, [PoseOf(place, Quaternion(0.0, 0.0, 0.0, 1.0)) for place in places])
        yield TRANSFORM, FrameTransform(time, ROOT, BODY, position, attitude)
        yield POSE, PoseInFrame(time, ROOT, PoseOf(position, attitude))
        yield LOCATION, _fix(time, BODY, state, frame)


def _fix(time: Time, frame_id: str, state: State, frame: LocalFrame) -> LocationFix:
    north, east, down = state.velocity_ned_mps
    return LocationFix(
        timestamp=time,
        frame_id=frame_id,
        latitude=state.lat_deg,
        longitude=state.lon_deg,
        altitude=state.height_m,
        position_covariance=list(frame.covariance_axes(state.covariance_position_m2)),
        position_covariance_type=KNOWN,
        heading=math.radians(state.yaw_deg),
        velocity=Vector3(east, north, -down),
    )


def _time(t_ns: int) -> Time:
    return Time(*divmod(t_ns, SECOND))
