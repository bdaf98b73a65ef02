"""Telemetry for a ground station: position, velocity, attitude with their covariances, the estimator's status, events as
texts, and answers to commands and parameter requests.

It uses a connection of its own, or the open link of a MAVLink input, in which case the autopilot routes it. No message
that could be mistaken for the autopilot's has the vehicle's system id: the marker on the map is a vehicle with a system id
of its own. Heartbeats are sent while states come from the estimator.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from threading import Event
from typing import Any, Protocol

from pymavlink.dialects.v20 import common

from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.estimator.solution import Mode
from fusiond.events import GnssPosition, GnssVelocity, Payload, Pressure, WheelSpeed
from fusiond.messages.types import EventMessage, HealthMessage, Message, Severity, State, StateMessage
from fusiond.ports.inputs import LiveInput
from fusiond.ports.outputs import Outbox, OutputLost
from fusiond.units import SECOND
from fusiond_adapters.mavlink.answers import HANDLED, Parameter, Responder
from fusiond_adapters.mavlink.decoder import NO_AUTOPILOT, Dialect, PeerSplitter, message_id
from fusiond_adapters.mavlink.link import MavlinkLink, link_of
from fusiond_adapters.mavlink.outgoing import (
    Origin,
    RateLimiter,
    Ratios,
    attitude_quaternion,
    estimator_status,
    global_position,
    local_position_ned,
    marker,
    status_texts,
)
from fusiond_adapters.mavlink.transport import Transport, opener

OUTBOX = 256  # messages
POLL_S = 0.05  # between two polls for messages from the ground station
HEARTBEAT_NS = SECOND
ALIVE_NS = 2 * SECOND  # heartbeats end this long after the last state
STATUS_HZ = 1.0
MARKER_HZ = 2.0
MAX_REQUESTS = 256  # frames that wait for an answer
AUTOPILOT_COMPONENT = 1  # the only one that QGroundControl shows as a vehicle on the map
SEVERITY: dict[Severity, int] = {
    "critical": common.MAV_SEVERITY_CRITICAL,
    "warning": common.MAV_SEVERITY_WARNING,
    "notice": common.MAV_SEVERITY_NOTICE,
    "info": common.MAV_SEVERITY_INFO,
}
STATUS = {
    Mode.ALIGNING: common.MAV_STATE_CALIBRATING,
    Mode.NOMINAL: common.MAV_STATE_ACTIVE,
    Mode.DEAD_RECKONING: common.MAV_STATE_ACTIVE,
    Mode.LOST: common.MAV_STATE_CRITICAL,
}
GLOBAL, LOCAL = common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT_COV, common.MAVLINK_MSG_ID_LOCAL_POSITION_NED_COV
ATTITUDE, ESTIMATOR = common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION_COV, common.MAVLINK_MSG_ID_ESTIMATOR_STATUS


class Connection(Protocol):
    """The connection to the ground station. `send` may raise OSError or EOFError where it is this output's own."""

    @property
    def identity(self) -> tuple[int, int]:
        """Our system and component."""

    sends_heartbeats: bool  # the output sends fusiond's heartbeats

    def send(self, message: Any, sender: Any = None) -> bool: ...
    def received(self) -> list[bytes]: ...
    def close(self) -> None: ...


class SharedConnection:
    """The open link of an input, which sends fusiond's heartbeats itself."""

    sends_heartbeats = False

    def __init__(self, link: MavlinkLink, rouse: Callable[[], None]) -> None:
        self._link, self._rouse = link, rouse
        self._requests: deque[bytes] = deque(maxlen=MAX_REQUESTS)
        self.send = link.send
        link.listeners.append(self._listen)

    @property
    def identity(self) -> tuple[int, int]:
        return self._link.housekeeping.identity

    def _listen(self, frame: bytes, _t_ns: int) -> None:
        """Called in the link's thread."""
        if message_id(frame) in HANDLED:
            self._requests.append(frame)
            self._rouse()

    def received(self) -> list[bytes]:
        return [self._requests.popleft() for _ in range(len(self._requests))]

    def close(self) -> None:
        self._link.listeners.remove(self._listen)


class OwnConnection:
    """A connection of its own."""

    sends_heartbeats = True

    def __init__(self, transport: Transport, system: Callable[[], int], component: int) -> None:
        self._transport, self._system = transport, system
        self._own_sender = common.MAVLink(None, srcSystem=system(), srcComponent=component)
        self._dialect = Dialect("common")
        self._splitter = PeerSplitter(self._dialect, datagrams=transport.datagrams)

    @property
    def identity(self) -> tuple[int, int]:
        return self._system(), self._own_sender.srcComponent

    def send(self, message: Any, sender: Any = None) -> bool:
        sender = sender or self._own_sender
        self._own_sender.srcSystem = self._system()
        packed = bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) & 0xFF
        return self._transport.write(packed)

    def received(self) -> list[bytes]:
        found = []
        for data, peer in self._transport.read(0):
            frames = self._splitter.feed(data, peer)
            if any(self._dialect.knows(message_id(frame)) for frame in frames):
                self._transport.heard(peer)
            found += [frame for frame in frames if message_id(frame) in HANDLED]
        return found

    def close(self) -> None:
        self._transport.close()


class GroundStation:
    """[ground_station]. `parameters` are offered besides its own. Raises ConfigError for a wrong connection string."""

    name = "ground_station"

    def __init__(
        self,
        config: Config,
        inputs: Mapping[str, LiveInput[Any]],
        now: Callable[[], int],
        parameters: Sequence[Parameter] = (),
    ) -> None:
        self._config, self._settings = config, config.ground_station
        self._geoid_m = config.vehicle.geoid_m
        self._links = [link_of(inputs, name) for name in config.mavlink if f"mavlink.{name}" in inputs]  # none in a replay
        self._now = now
        self.outbox = Outbox(OUTBOX, (StateMessage, HealthMessage, EventMessage))
        self._open = self._opener()
        over = f"MAVLink {self._settings.link}" if self._settings.link else self._settings.connection
        self.about = f"ground station over {over}"
        rate_hz = self._settings.rate_hz
        self.limiters = {number: RateLimiter(rate_hz) for number in (GLOBAL, LOCAL, ATTITUDE)}
        self.limiters[ESTIMATOR] = RateLimiter(STATUS_HZ)
        self._responder = Responder([*self._parameters(), *parameters], self.limiters)
        self._parser = common.MAVLink(None)
        self._marker = common.MAVLink(None, srcSystem=self._settings.marker_system, srcComponent=AUTOPILOT_COMPONENT)
        self._marker_limiter = RateLimiter(MARKER_HZ if self._settings.marker_system else 0.0)
        self._origin: Origin | None = None  # of the local frame: the first state not lost, kept
        self._ratios = Ratios()
        self._mode = Mode.ALIGNING
        self._state_ns: int | None = None  # when the last state was read from the outbox
        self._next_heartbeat_ns, self._texts = 0, 0
        self._counts = dict.fromkeys(("sent", "lost", "texts", "requests"), 0)

    def session(self, stop: Event) -> None:
        """Send messages and answer requests until `stop` is set. Raises OutputLost."""
        try:
            connection = self._open()
        except OSError as error:
            raise OutputLost(f"cannot be opened: {error}") from error
        try:
            while not stop.is_set():
                self._step(connection, POLL_S)
            self._step(connection, 0)
        except (OSError, EOFError) as error:
            raise OutputLost(f"lost: {error}") from error
        finally:
            connection.close()

    def _step(self, connection: Connection, timeout_s: float) -> None:
        for message in self.outbox.take(timeout_s):
            self._send_message(connection, message)
        for frame in connection.received():
            self._answer(connection, frame)
        self._send_heartbeats(connection)

    def _opener(self) -> Callable[[], Connection]:
        settings = self._settings
        if settings.link is not None:
            link = next(link for link in self._links if link.name == settings.link)
            return lambda: SharedConnection(link, self.outbox.rouse)
        try:
            open_transport = opener(settings.connection or "", settings.baud)
        except ValueError as error:
            raise ConfigError(f"ground_station.connection: {error}") from error
        return lambda: OwnConnection(open_transport(), self._system, settings.component)

    def _system(self) -> int:
        """Our system id on a connection of our own: as configured, or the autopilot's, or 1 until that is known."""
        known = (link.housekeeping.target[0] for link in self._links if link.housekeeping.target)
        return self._settings.system or next(known, 1)

    # --- Messages sent

    def _send_message(self, connection: Connection, message: Message) -> None:
        if isinstance(message, StateMessage):
            self._send_state(connection, message)
        elif isinstance(message, HealthMessage):
            self._ratios = ratios(message, self._config)
        elif isinstance(message, EventMessage):
            self._texts = self._texts % 0xFFFF + 1
            self._counts["texts"] += 1
            for chunk in status_texts(SEVERITY[message.severity], f"fusiond: {message.text}", self._texts):
                self._send(connection, chunk)

    def _send_state(self, connection: Connection, message: StateMessage) -> None:
        self._mode, self._state_ns = message.mode, self._now()
        if self._due(ESTIMATOR, message.t_ns):
            self._send(connection, estimator_status(message, self._ratios))
        state = message.state
        if state is None or message.mode is Mode.LOST:
            return
        origin = self._origin = self._origin or Origin.of(state)
        self._send_telemetry(connection, message, state, origin)
        if self._marker_limiter.due(message.t_ns):
            self._send(connection, marker(message, state, origin, self._geoid_m), self._marker)

    def _send_telemetry(self, connection: Connection, message: StateMessage, state: State, origin: Origin) -> None:
        if self._due(GLOBAL, message.t_ns):
            self._send(connection, global_position(message, state, origin, self._geoid_m))
        if self._due(LOCAL, message.t_ns):
            self._send(connection, local_position_ned(message, state, origin))
        if self._due(ATTITUDE, message.t_ns):
            self._send(connection, attitude_quaternion(message, state))

    def _due(self, number: int, t_ns: int) -> bool:
        """Whether a message is due by its rate, or was requested."""
        due = self.limiters[number].due(t_ns)
        if number in self._responder.requested:
            self._responder.requested.discard(number)
            return True
        return due

    def _send_heartbeats(self, connection: Connection) -> None:
        """Send heartbeats while the estimator's states come."""
        now = self._now()
        if self._state_ns is None or now - self._state_ns > ALIVE_NS or now < self._next_heartbeat_ns:
            return
        self._next_heartbeat_ns = now + HEARTBEAT_NS
        status = STATUS[self._mode]
        if connection.sends_heartbeats:
            kind = common.MAV_TYPE_ONBOARD_CONTROLLER
            self._send(connection, common.MAVLink_heartbeat_message(kind, NO_AUTOPILOT, 0, 0, status, 3))
        if self._settings.marker_system:
            kind = common.MAV_TYPE_GROUND_ROVER
            heartbeat = common.MAVLink_heartbeat_message(kind, common.MAV_AUTOPILOT_GENERIC, 0, 0, status, 3)
            self._send(connection, heartbeat, self._marker)

    def _send(self, connection: Connection, message: Any, sender: Any = None) -> None:
        self._counts["sent" if connection.send(message, sender) else "lost"] += 1

    # --- Answers

    def _answer(self, connection: Connection, frame: bytes) -> None:
        try:
            message = self._parser.decode(bytearray(frame))
        except common.MAVError:
            return
        self._counts["requests"] += 1
        for answer in self._responder.answers(message, connection.identity):
            self._send(connection, answer)
        if self._settings.marker_system:
            for answer in self._responder.answers(message, (self._settings.marker_system, AUTOPILOT_COMPONENT)):
                self._send(connection, answer, self._marker)

    def _parameters(self) -> list[Parameter]:
        publish_hz = self._config.publish.rate_hz
        return [
            Parameter("FUS_RATE_HZ", lambda: publish_hz),
            Parameter("FUS_HORIZON_S", lambda: self._config.filter.horizon_s),
            Parameter("GS_RATE_HZ", lambda: self.limiters[GLOBAL].rate_hz, self._set_rate, 0.1, publish_hz),
        ]

    def _set_rate(self, rate_hz: float) -> None:
        for number in (GLOBAL, LOCAL, ATTITUDE):
            self.limiters[number].rate_hz = rate_hz

    def counts(self) -> dict[str, int]:
        """Messages sent and lost, texts, requests received."""
        return dict(self._counts)

    def notes(self) -> dict[str, str]:
        """None."""
        return {}


def ratios(health: HealthMessage, config: Config) -> Ratios:
    """The largest test ratios of the sources that are present, as innovation over the gate, not squared."""

    streams = config.streams()

    def largest(*payloads: type[Payload]) -> float:
        names = [name for name, source in streams.items() if source.stream.payload in payloads]
        known = [health.sources[name] for name in names if name in health.sources]
        found = [source.test_ratio for source in known if source.present and source.test_ratio is not None]
        return math.sqrt(max(found)) if found else math.nan

    return Ratios(largest(GnssVelocity, WheelSpeed), largest(GnssPosition), largest(GnssPosition, Pressure))
