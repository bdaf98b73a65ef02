"""States of a moving vehicle, peers over UDP and TCP, and stand-ins for autopilots, for the tests of MAVLink outputs.

The stand-ins drop and refuse what ArduPilot and PX4 do, and turn what they accept into latitude, longitude and velocity
over ground by the autopilots' own equations. References: ArduPilot's GCS_Common.cpp (handle_odometry,
handle_common_vision_position_estimate_data, send_gps_global_origin), AP_VisualOdom_MAV.cpp (handle_pose_estimate),
AP_NavEKF3_Measurements.cpp (writeExtNavData), AP_GPS_MAV.cpp and Location.cpp (offset_latlng); PX4's
mavlink_receiver.cpp (handle_message_odometry, handle_message_vision_position_estimate) and geo.cpp (reproject).
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple, Protocol

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fusiond.config.schema import Config
from fusiond.estimator.solution import Mode, Solution, SolutionState
from fusiond.maths.rotation import matrix_from_euler, quaternion
from fusiond.messages.from_solution import state_message
from fusiond.messages.types import OutcomeCounts, State, StateMessage
from fusiond.ports.inputs import Inbox
from fusiond.units import MILLISECOND as MS
from fusiond_adapters.host.clock import HostClock
from fusiond_adapters.mavlink.housekeeping import Housekeeping
from fusiond_adapters.mavlink.link import MavlinkLink
from tests.helpers.live import configuration
from tests.helpers.network import DEADLINE

SYSTEM, COMPONENT = 7, 1
CLOCK = HostClock()
Triple = tuple[float, float, float]


def state_at(t_ns: int, number: int = 0, mode: Mode = Mode.NOMINAL, resets: int = 0, scale: float = 1.0,
             age_ns: int | None = 5 * MS) -> StateMessage:  # fmt: skip
    """A state on a curve, with a full covariance; `scale` is of its sigmas."""
    root = np.random.default_rng(number).normal(size=(9, 9)) * np.repeat((0.3, 0.05, 0.02), 3)[:, None] * scale
    w, x, y, z = quaternion(matrix_from_euler(0.05 * number, -0.1, 1.7 + 0.2 * number)).tolist()
    estimate = SolutionState(
        latitude=0.8401 + number * 1.1e-5, longitude=0.2 - number * 2.3e-5, height=612.5 + 3.25 * number,
        velocity_n=(3.0 + number, -8.0, 0.25), quaternion_nb=(w, x, y, z),
        angular_rate_b=(0.01, -0.02, 0.1 * number), acceleration_b=(0.3, -0.2, -9.7),
        gyro_bias=(1e-3, 0.0, 0.0), accel_bias=(0.02, 0.0, 0.0), wheel_scale=0.01, mount=(0.0, 0.0),
        covariance=root @ root.T, sigma_gyro_bias=(1e-3, 2e-3, 3e-3), sigma_accel_bias=(0.01, 0.02, 0.03),
        sigma_wheel_scale=1e-3, sigma_mount=(1e-3, 1e-3))  # fmt: skip
    without = mode in (Mode.ALIGNING,)
    return state_message(Solution(t_ns, mode, age_ns, resets, None if without else estimate), "test", OutcomeCounts())


def recent(count: int, spacing_ms: int = 40, **changes: Any) -> list[StateMessage]:
    """States up to now."""
    now = CLOCK.now_ns()
    return [state_at(now - (count - 1 - number) * spacing_ms * MS, number, **changes) for number in range(count)]


# --- Peers


class Peer(Protocol):
    connection: str  # for the link under test

    def send(self, data: bytes) -> None: ...
    def receive(self) -> bytes: ...
    def close(self) -> None: ...


class UdpPeer:
    """Sends to a link that listens, receives the replies."""

    def __init__(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self._address = probe.getsockname()
        self.connection = f"udpin:127.0.0.1:{self._address[1]}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.01)

    def follow(self, other: UdpPeer) -> None:
        """Send to the same link as another peer."""
        self._address = other._address

    def send(self, data: bytes) -> None:
        self._socket.sendto(data, self._address)

    def receive(self) -> bytes:
        try:
            return self._socket.recv(65536)
        except TimeoutError:
            return b""

    def close(self) -> None:
        self._socket.close()


class UdpListener(UdpPeer):
    """Waits for the one under test to send first, as a ground station does."""

    def __init__(self) -> None:
        super().__init__()
        self._socket.bind(("127.0.0.1", 0))
        self.connection = f"udpout:127.0.0.1:{self._socket.getsockname()[1]}"

    def receive(self) -> bytes:
        try:
            data, self._address = self._socket.recvfrom(65536)
        except TimeoutError:
            return b""
        return data


class TcpPeer:
    """Listens; the one under test connects. `buffer` limits what it accepts without being read."""

    def __init__(self, buffer: int | None = None) -> None:
        self._listener = socket.socket()
        if buffer:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        self._listener.bind(("127.0.0.1", 0))
        self._listener.listen(1)
        self._listener.settimeout(DEADLINE)
        self.connection = f"tcp:127.0.0.1:{self._listener.getsockname()[1]}"
        self._socket: socket.socket | None = None

    @property
    def connected(self) -> socket.socket:
        if self._socket is None:
            self._socket = self._listener.accept()[0]
            self._socket.settimeout(0.01)
        return self._socket

    def send(self, data: bytes) -> None:
        self.connected.sendall(data)

    def receive(self) -> bytes:
        try:
            return self.connected.recv(65536)
        except TimeoutError:
            return b""

    def close(self) -> None:
        if self._socket:
            self._socket.close()
        self._listener.close()


class Endpoint:
    """A peer with the messages that it received; pymavlink checks every frame."""

    def __init__(self, peer: Peer, system: int = SYSTEM, component: int = COMPONENT) -> None:
        self.peer = peer
        self.messages: list[Any] = []
        self.sent = 0
        self.sender = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._parser = dialect.MAVLink(None)
        self._parser.robust_parsing = True

    def send(self, message: Any) -> None:
        self.sent += 1
        self.peer.send(bytes(message.pack(self.sender)))
        self.sender.seq = (self.sender.seq + 1) & 0xFF

    def heartbeat(self, maker: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA) -> None:
        self.send(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GROUND_ROVER, maker, 0, 0, 4, 3))

    def listen(self) -> None:
        self.messages += self._parser.parse_buffer(self.peer.receive()) or []

    def of(self, *names: str) -> list[Any]:
        return [message for message in self.messages if message.get_type() in names]

    def until(self, condition: Callable[[], bool]) -> None:
        """Listen until a condition holds."""
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, f"not reached; received {[m.get_type() for m in self.messages]}"
            self.listen()

    def texts(self) -> list[str]:
        """STATUSTEXTs, put together from their chunks as the protocol has it."""
        whole: list[str] = []
        parts: dict[int, list[str]] = {}
        for message in self.of("STATUSTEXT"):
            if message.id == 0:
                whole.append(message.text)
                continue
            chunks = parts.setdefault(message.id, [])
            assert message.chunk_seq == len(chunks)
            chunks.append(message.text)
            if len(message.text) < 50:  # it has a zero in it
                whole.append("".join(parts.pop(message.id)))
        return whole


def link_to(peer: Peer, folder: Path, more: str = "", link: str = "") -> tuple[Config, MavlinkLink]:
    """A link to a peer; `link` has more keys of its section."""
    settings = configuration(folder, peer.connection, more, link=link)
    return settings, link_of(settings)


def link_of(settings: Config) -> MavlinkLink:
    """The link of a configuration."""
    return MavlinkLink(settings, "fc", Inbox(4096, lambda: None, hash), CLOCK, lambda: True)


class Recorder:
    """Stands in for a link whose peer does not matter."""

    def __init__(self, settings: Any, *, open_: bool = True) -> None:
        self.listeners: list[Callable[[bytes, int], None]] = []
        self.housekeeping = Housekeeping(settings, "fc")
        self.sent: list[Any] = []
        self.open = open_

    def send(self, message: Any, sender: Any = None) -> bool:
        if self.open:
            self.sent.append(message)
        return self.open

    def kinds(self) -> list[str]:
        return [message.get_type() for message in self.sent]


class HasSession(Protocol):
    def session(self, stop: Event) -> None: ...


@contextmanager
def serving(*parts: HasSession) -> Iterator[None]:
    """The sessions of inputs and outputs, each in a thread of its own."""
    stop = Event()
    threads = [Thread(target=part.session, args=(stop,)) for part in parts]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(DEADLINE)
    assert not any(thread.is_alive() for thread in threads)


def greeted(endpoint: Endpoint, link: MavlinkLink, maker: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA) -> None:
    """Wait until the link has received the peer's heartbeat: UDP has no other way to know that it listens."""
    endpoint.heartbeat(maker)
    end = time.monotonic() + DEADLINE
    while link.housekeeping.target is None:
        assert time.monotonic() < end
        endpoint.listen()
        endpoint.heartbeat(maker)


# --- Autopilots


class Accepted(NamedTuple):
    """The data that an autopilot's estimator gets; None for what it does not get."""

    time_us: int
    latitude_deg: float
    longitude_deg: float
    height_m: float
    velocity_n: Triple | None
    quaternion: tuple[float, ...] | None
    errors: tuple[float, ...]  # as the estimator uses them: ArduPilot sigmas of position and yaw, PX4 variances
    reset_counter: int | None
    quality: int


class ArduPilot:
    """ArduPilot with VISO_TYPE 1 and its other parameters as they come, and the EKF's origin given by the test; `dropped`
    counts what it drops silently. `position` is where it takes itself to be, `told` how often another reset_counter told it
    of a jump."""

    M_PER_E7 = 0.011131884502145034  # LOCATION_SCALING_FACTOR
    INTERVAL_MS = 20  # extNavIntervalMin_ms
    POSITION_NOISE, MAX_POSITION_NOISE = 0.2, 100.0  # m, VISO_POS_M_NSE
    YAW_NOISE, MAX_YAW_NOISE = 0.2, 1.5  # rad, VISO_YAW_M_NSE
    LEAST_YAW_ERROR = math.radians(5.0)  # EKF3's own

    def __init__(self, origin: Triple, quality_minimum: int = 0) -> None:
        self._origin, self._quality_minimum = origin, quality_minimum
        self.dropped = self.told = 0
        self.position: Triple | None = None  # latitude, longitude [deg], height [m]
        self._last_ms: int | None = None
        self._reset_counter: int | None = None

    def accept(self, m: Any) -> Accepted | None:
        accepted = getattr(self, f"_{m.get_type().lower()}")(m)
        self.dropped += accepted is None
        assert accepted is None or isinstance(accepted, Accepted)
        if accepted is not None:
            self.position = accepted.latitude_deg, accepted.longitude_deg, accepted.height_m
            self.told += self._reset_counter not in (None, accepted.reset_counter)
            self._reset_counter = accepted.reset_counter
        return accepted

    def answer(self, m: Any) -> Any:
        """The GPS_GLOBAL_ORIGIN that a command asks for; None for another message."""
        if m.get_type() != "COMMAND_LONG" or m.command != 512 or m.param1 != 49:
            return None
        latitude, longitude, height = self._origin
        altitude_mm = round(height * 1e2) * 10
        return dialect.MAVLink_gps_global_origin_message(round(latitude * 1e7), round(longitude * 1e7), altitude_mm)

    def _odometry(self, m: Any) -> Accepted | None:
        if m.frame_id != 20 or m.child_frame_id != 12:  # MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD
            return None
        if m.quality < self._quality_minimum:
            return None
        velocity = rotated(m.q, (m.vx, m.vy, m.vz))
        return self._pose(m.time_usec, m, tuple(m.q), m.pose_covariance, (velocity, m.reset_counter, m.quality))

    def _vision_position_estimate(self, m: Any) -> Accepted | None:
        q = quaternion(matrix_from_euler(m.roll, m.pitch, m.yaw)).tolist()
        return self._pose(m.usec, m, tuple(q), m.covariance, (None, m.reset_counter, 0))

    def _pose(self, time_us: int, m: Any, q: tuple[float, ...], covariance: list[float], rest: Any) -> Accepted | None:
        time_ms = time_us // 1000
        if self._last_ms is not None and time_ms - self._last_ms < self.INTERVAL_MS:
            return None
        self._last_ms = time_ms
        position = yaw = 0.0
        if not math.isnan(covariance[0]):  # not sigmas, nor variances: this is what it does
            position = math.cbrt(sum(covariance[i] ** 2 for i in (0, 6, 11)))
            yaw = math.cbrt(sum(covariance[i] ** 2 for i in (15, 18, 20)))
        errors = (
            min(max(position, self.POSITION_NOISE), self.MAX_POSITION_NOISE),
            max(min(max(yaw, self.YAW_NOISE), self.MAX_YAW_NOISE), self.LEAST_YAW_ERROR),
        )
        latitude, longitude, height = self._origin
        lat = latitude + m.x / self.M_PER_E7 / 1e7
        scale = max(math.cos(math.radians((lat + latitude) / 2)), 0.01)
        lon = longitude + m.y / self.M_PER_E7 / 1e7 / scale
        velocity, resets, quality = rest
        return Accepted(time_us, lat, lon, height - m.z, velocity, q, errors, resets, quality)

    def _gps_input(self, m: Any) -> Accepted | None:
        if m.fix_type < 3 or m.time_week == 0 or m.ignore_flags:
            return None
        q = None if m.yaw == 0 else quaternion(matrix_from_euler(0, 0, math.radians(m.yaw / 100))).tolist()
        errors = m.horiz_accuracy, m.vert_accuracy, m.speed_accuracy
        time_us = m.time_week * 604_800_000_000 + m.time_week_ms * 1000
        return Accepted(time_us, m.lat / 1e7, m.lon / 1e7, m.alt, (m.vn, m.ve, m.vd), q, errors, None, 0)


class Px4:
    """With the local frame's reference given by the test. `refused` counts what it refuses."""

    RADIUS = 6_371_000.0

    def __init__(self, origin: Triple, quality_minimum: int = 0) -> None:
        self._origin, self._quality_minimum = origin, quality_minimum
        self.refused = 0

    def accept(self, m: Any) -> Accepted | None:
        accepted = getattr(self, f"_{m.get_type().lower()}", lambda _: None)(m)
        self.refused += accepted is None
        assert accepted is None or isinstance(accepted, Accepted)
        return accepted

    def _odometry(self, m: Any) -> Accepted | None:
        if m.estimator_type not in (0, 1, 2, 3):  # UNKNOWN, NAIVE, VISION, VIO; MOCAP goes elsewhere
            return None
        if m.frame_id != 1:  # in LOCAL_FRD (20) the heading is arbitrary: no use where north is known
            return None
        if m.child_frame_id != 12 or not all(map(math.isfinite, (*m.q, m.x, m.y, m.z, m.vx, m.vy, m.vz))):
            return None
        if m.quality < self._quality_minimum:
            return None
        pose, twist = m.pose_covariance, m.velocity_covariance
        diagonal = [pose[i] for i in (0, 6, 11, 15, 18, 20)] + [twist[i] for i in (0, 6, 11)]
        variances = () if m.estimator_type == 1 else tuple(diagonal)
        velocity = rotated(m.q, (m.vx, m.vy, m.vz))
        return Accepted(m.time_usec, *self._reprojected(m), velocity, tuple(m.q), variances, m.reset_counter, m.quality)

    def _vision_position_estimate(self, m: Any) -> Accepted:
        q = quaternion(matrix_from_euler(m.roll, m.pitch, m.yaw)).tolist()
        variances = tuple(m.covariance[i] for i in (0, 6, 11, 15, 18, 20))
        return Accepted(m.usec, *self._reprojected(m), None, tuple(q), variances, m.reset_counter, 0)

    def _reprojected(self, m: Any) -> Triple:
        latitude, longitude, height = self._origin
        x, y, reference = m.x / self.RADIUS, m.y / self.RADIUS, math.radians(latitude)
        c = math.hypot(x, y)
        if c == 0:
            return latitude, longitude, height - m.z
        lat = math.asin(math.cos(c) * math.sin(reference) + x * math.sin(c) * math.cos(reference) / c)
        east = y * math.sin(c)
        lon = math.atan2(east, c * math.cos(reference) * math.cos(c) - x * math.sin(reference) * math.sin(c))
        return math.degrees(lat), longitude + math.degrees(lon), height - m.z


def rotated(q: Any, v: Triple) -> Triple:
    """v turned by a quaternion (w, x, y, z): v + 2w (u x v) + 2 u x (u x v)."""
    w, u = q[0], np.array(q[1:])
    t = 2 * np.cross(u, v)
    x, y, z = (np.array(v) + w * t + np.cross(u, t)).tolist()
    return x, y, z


def state_of(state: StateMessage) -> State:
    assert state.state is not None
    return state.state
