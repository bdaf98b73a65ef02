"""Published messages to ROS 2 messages: frames, units and levels by ROS's conventions (REP 103, REP 105)."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fusiond.config.outputs import Ros2
from fusiond.estimator.solution import Mode
from fusiond.messages.drift import Drift
from fusiond.messages.local_frame import LocalFrame, LocalState, OdometryFrame, Placed
from fusiond.messages.types import (
    HealthMessage,
    InputHealth,
    OutputHealth,
    SourceHealth,
    State,
    StateMessage,
    Triple,
)
from fusiond.units import SECOND
from fusiond_adapters.ros2 import cdr
from fusiond_adapters.ros2.cdr import ERROR, OK, WARN, Status

FIT = (Mode.NOMINAL, Mode.DEAD_RECKONING)
LEVELS = {Mode.NOMINAL: OK, Mode.DEAD_RECKONING: WARN, Mode.ALIGNING: WARN, Mode.LOST: ERROR}
RESET_SHOWN_NS = 5 * SECOND  # how long the diagnostics warn of a reset
KINDS = {  # by topic
    "odometry": cdr.ODOMETRY,
    "odometry/local": cdr.ODOMETRY,
    "fix": cdr.FIX,
    "twist": cdr.TWIST,
    "/tf": cdr.TF,
    "/diagnostics": cdr.DIAGNOSTICS,
}


class Converter:
    """Converts the messages of one vehicle; keeps its origin and its odometry frame."""

    def __init__(self, section: Ros2) -> None:
        self.unfit = 0  # messages without a usable state, which are not sent
        self._section = section
        self._frame: LocalFrame | None = None
        if section.origin is not None:
            latitude, longitude, height = section.origin
            self._frame = LocalFrame(math.radians(latitude), math.radians(longitude), height)
        self._odometry_frame = OdometryFrame()
        self._drift = Drift()
        self._speed = 0.0  # m/s, of the last state
        self._sent_ns = 0  # its stamp
        self._period_ns = SECOND / section.rate_hz
        self._slot = 0
        self._odometry = cdr.OdometryTemplate(section.map_frame, section.base_frame)
        self._local_odometry = cdr.OdometryTemplate(section.odom_frame, section.base_frame)
        self._twist = cdr.TwistTemplate(section.base_frame)
        self._fixes = {
            Mode.NOMINAL: cdr.FixTemplate(section.base_frame, cdr.STATUS_FIX),
            Mode.DEAD_RECKONING: cdr.FixTemplate(section.base_frame, cdr.STATUS_NO_FIX),
        }
        self._transforms = cdr.TransformsTemplate((section.map_frame, section.odom_frame, section.base_frame))
        self._resets: int | None = None  # as last published
        self._reset_ns: int | None = None  # of the last reset
        self._dropped: dict[str, int] = {}  # by input or output, as last published

    @property
    def origin(self) -> str:
        """Latitude, longitude [deg], height [m] of the map frame's origin."""
        if self._frame is None:
            return "none yet"
        latitude, longitude, height = self._frame.origin
        return f"{math.degrees(latitude):.9f}, {math.degrees(longitude):.9f}, {height:.3f}"

    def state(self, message: StateMessage) -> Iterator[tuple[str, bytes]]:
        """Topic and CDR of each message of a state; none if it is not due or not usable."""
        slot = int(message.t_ns // self._period_ns)
        if slot == self._slot:
            return
        self._slot = slot
        state, t_ns = message.state, message.t_ns
        if state is None or message.mode not in FIT:
            self.unfit += 1
            return
        if self._frame is None:
            self._frame = LocalFrame.at(state)
        local = self._frame.state(state)
        rate_variance = _squared(state)
        odom, body = self._follow(message, local, state.sigma_gyro_bias_rps)
        yield "odometry", self._odometry.filled(t_ns, local, rate_variance)
        covariance = self._drift.covariance(local, body)
        yield "odometry/local", self._local_odometry.placed(t_ns, body, covariance, local, rate_variance)
        if self._section.tf:
            yield "/tf", self._transforms.filled(t_ns, (odom, body))
        yield "twist", self._twist.filled(t_ns, local, rate_variance)
        position = (state.lat_deg, state.lon_deg, state.height_m)
        covariance = self._frame.covariance_axes(state.covariance_position_m2)
        yield "fix", self._fixes[message.mode].filled(t_ns, position, covariance)

    def _follow(self, message: StateMessage, local: LocalState, sigma_gyro_bias: Triple) -> tuple[Placed, Placed]:
        """The odometry frame in the map, the body in the odometry frame; and how far it may have drifted there."""
        t_ns, speed = message.t_ns, math.hypot(*local.velocity_b)
        blind = self._odometry_frame.loses_sight(t_ns, message.resets)
        odom, body = self._odometry_frame.follow(t_ns, local, message.resets)
        if blind:
            self._drift.lose_sight(t_ns, max(speed, self._speed) * (t_ns - self._sent_ns) / SECOND)
        else:
            self._drift.follow(t_ns, local, body, sigma_gyro_bias)
        self._speed, self._sent_ns = speed, t_ns
        return odom, body

    def health(self, message: HealthMessage) -> Iterator[tuple[str, bytes]]:
        """Topic and CDR of the diagnostics."""
        statuses = [self._state_status(message)]
        statuses += [_source_status(name, source) for name, source in message.sources.items()]
        for kind, parts in (("input", message.inputs), ("output", message.outputs)):
            statuses += [self._part_status(f"{kind} {name}", part) for name, part in parts.items()]
        yield "/diagnostics", cdr.diagnostics(message.t_ns, message.vehicle, statuses)

    def _state_status(self, message: HealthMessage) -> Status:
        if self._resets is not None and message.resets > self._resets:
            self._reset_ns = message.t_ns
        self._resets = message.resets
        values = {
            "mode": message.mode.value,
            "resets": message.resets,
            "reset reason": message.reset_reason or "",
            "origin": self.origin,
            "uptime [s]": message.uptime_s,
            **_counts(message),
        }
        level, text = LEVELS[message.mode], message.mode.value
        if self._reset_ns is not None and message.t_ns - self._reset_ns < RESET_SHOWN_NS:
            text += f"; the state was reset, so the pose in {self._section.map_frame} jumped: {message.reset_reason}"
            level = max(level, WARN)
        return Status(level, "fusiond: state", text, values)

    def _part_status(self, name: str, part: InputHealth | OutputHealth) -> Status:
        before, self._dropped[name] = self._dropped.get(name, 0), part.dropped
        lost = part.dropped - before
        values: dict[str, object] = {"dropped": part.dropped, **part.counts}
        if isinstance(part, OutputHealth):
            values |= {"offered": part.offered, **part.notes}
        else:
            values["received"] = part.received
        return Status(WARN if lost > 0 else OK, f"fusiond: {name}", f"{lost} dropped" if lost > 0 else "", values)


def _source_status(name: str, source: SourceHealth) -> Status:
    status = (source.status or "nominal") if source.present else "absent"
    values = {"rate [1/s]": source.rate_hz, "age [ms]": source.age_ms, "test ratio": source.test_ratio}
    values |= {"mean NIS": source.nis_mean, **_counts(source)}
    text = f"{status}: {source.reason}" if source.reason else status
    known = {key: "" if value is None else value for key, value in values.items()}
    return Status(OK if status == "nominal" else WARN, f"fusiond: {name}", text, known)


def _counts(part: HealthMessage | SourceHealth) -> dict[str, int]:
    return {name: getattr(part.outcomes, name) for name in part.outcomes.__struct_fields__}


def _squared(state: State) -> tuple[float, float, float]:
    x, y, z = state.sigma_gyro_bias_rps
    return x * x, y * y, z * z
