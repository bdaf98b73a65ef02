"""The state sent to the autopilot as an aiding measurement of its own estimator, and whether that estimator uses it.

Messages go out on the open link of a MAVLink input, from this output's own thread. Only a state within the configured
limits is sent; if one is not, the health and a STATUSTEXT give the reason. Whether the autopilot uses the state is read
from its EKF_STATUS_REPORT or ESTIMATOR_STATUS, which the link requests (see `housekeeping`), and from the STATUSTEXTs of
ArduPilot's EKF3: "is using external nav data", "stopped aiding". It is asked for the origin of its local frame, which then
is that of the positions sent (see `shared_frame`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from threading import Event
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fusiond.config.outputs import Autopilot
from fusiond.config.schema import Config
from fusiond.estimator.solution import Mode
from fusiond.messages.types import State, StateMessage
from fusiond.ports.outputs import POLL_S, KeptFrame, Outbox
from fusiond.units import SECOND
from fusiond_adapters.mavlink.answers import Parameter
from fusiond_adapters.mavlink.decoder import message_id
from fusiond_adapters.mavlink.link import MavlinkLink
from fusiond_adapters.mavlink.outgoing import (
    CONVENTIONS,
    Origin,
    RateLimiter,
    gps_input,
    odometry,
    set_origin,
    status_texts,
    vision_position,
)
from fusiond_adapters.mavlink.shared_frame import SharedFrame

OUTBOX = 64  # messages
MIN_HZ = 4.0  # below this rate ArduPilot stops using the data
MAX_AGE_NS = SECOND  # an older state is not sent
MAX_STATUS_AGE_NS = 5 * SECOND  # an older estimator status is ignored
TEXT_NS = 5 * SECOND  # between two STATUSTEXTs
ORIGIN_NS = 2 * SECOND  # between two requests for the autopilot's origin, and two that it take ours, until it reports one
ORIGIN_AGAIN_NS = 10 * SECOND  # between two requests from then on: it may get another when it reboots
GATE = 1.0  # of a test ratio
ARDUPILOT_UNINITIALISED = 1024  # EKF_STATUS_FLAGS; in ESTIMATOR_STATUS the bit means a GPS glitch
HAS_POSITION = dialect.ESTIMATOR_POS_HORIZ_REL | dialect.ESTIMATOR_POS_HORIZ_ABS
NAMES = {dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot", dialect.MAV_AUTOPILOT_PX4: "px4"}
EXTERNAL_NAV = re.compile(r"EKF\d IMU\d+ is using external nav data")
STOPPED_AIDING = re.compile(r"EKF\d IMU\d+ stopped aiding")

READ = {
    dialect.MAVLINK_MSG_ID_HEARTBEAT,
    dialect.MAVLINK_MSG_ID_STATUSTEXT,
    dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT,
    dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
}


def unfit(message: StateMessage, limits: Autopilot) -> tuple[str, str] | None:
    """Why a state must not be sent: the kind of reason in one word, and the reason in full. None: it may be sent."""
    state = message.state
    if state is None or message.mode in (Mode.ALIGNING, Mode.LOST):
        return message.mode.value, message.fault or message.mode.value.replace("_", " ")
    if not (message.heading_confirmed or limits.unconfirmed_heading):
        return "heading", "nothing has confirmed the given or stored heading yet: drive"
    if message.mode is Mode.DEAD_RECKONING and not limits.dead_reckoning:
        return "dead_reckoning", "dead reckoning"
    if message.age_ms is None or message.age_ms > limits.age_ms:
        return "age", f"the last IMU sample is older than {limits.age_ms:g} ms"
    horizontal = max(state.sigma_position_ned_m[:2])
    for name, sigma, limit, unit in (
        ("position", horizontal, limits.position_sigma_m, "m"),
        ("velocity", state.sigma_velocity_mps, limits.velocity_sigma_mps, "m/s"),
        ("yaw", state.sigma_yaw_deg, limits.yaw_sigma_deg, "deg"),
    ):
        if sigma > limit:
            return name, f"{name} sigma {sigma:.3g} {unit}, limit {limit:g} {unit}"
    return None


def quality(state: State, limits: Autopilot) -> int:
    """1 to 100: 100 where all sigmas are zero, 1 where the worst of them is at its limit."""
    worst = max(
        max(state.sigma_position_ned_m[:2]) / limits.position_sigma_m,
        state.sigma_velocity_mps / limits.velocity_sigma_mps,
        state.sigma_yaw_deg / limits.yaw_sigma_deg,
    )
    return max(1, round(100 - 99 * worst))


class Readback:
    """The autopilot's reports on its own estimator. `receive` is called by the link's thread."""

    def __init__(self, link: MavlinkLink, kind: str) -> None:
        self.origin: Origin | None = None  # of its local frame; its height is above the sea
        self.undulation_m = 0.0  # of the geoid, by its receiver; 0 where that gives only heights above the sea
        self._link, self._kind = link, kind
        self._parser = dialect.MAVLink(None)
        self._actual_kind = kind  # according to its heartbeat
        self._uses_external: bool | None = None  # according to its STATUSTEXTs
        self._report: tuple[int, int, Sequence[float]] | None = None  # stamp, flags, ratios

    def receive(self, frame: bytes, t_ns: int) -> None:
        """Read a frame of the link."""
        if message_id(frame) not in READ:
            return
        try:
            message = self._parser.decode(bytearray(frame))
        except dialect.MAVError:
            return  # another dialect's message with this number, or a damaged frame
        if (message.get_srcSystem(), message.get_srcComponent()) != self._link.housekeeping.target:
            return
        kind = message.get_msgId()
        if kind == dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
            self.origin = Origin(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
        elif kind == dialect.MAVLINK_MSG_ID_GPS_RAW_INT:
            if message.alt_ellipsoid:
                self.undulation_m = (message.alt_ellipsoid - message.alt) / 1e3
        else:
            self._receive_status(message, kind, t_ns)

    def _receive_status(self, message: Any, kind: int, t_ns: int) -> None:
        if kind == dialect.MAVLINK_MSG_ID_HEARTBEAT:
            self._actual_kind = NAMES.get(message.autopilot, self._kind)
        elif kind == dialect.MAVLINK_MSG_ID_STATUSTEXT:
            if EXTERNAL_NAV.search(message.text):
                self._uses_external = True
            elif STOPPED_AIDING.search(message.text):
                self._uses_external = False
        elif kind == dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT:
            flags = message.flags & ~ARDUPILOT_UNINITIALISED
            if message.flags & ARDUPILOT_UNINITIALISED:
                flags = 0
            ratios = message.velocity_variance, message.pos_horiz_variance, message.pos_vert_variance
            self._report = t_ns, flags, ratios
        else:
            ratios = message.vel_ratio, message.pos_horiz_ratio, message.pos_vert_ratio
            self._report = t_ns, message.flags, ratios

    def verdict(self, now_ns: int) -> str:
        """Whether the autopilot uses the state. The first word is yes, no, likely or unknown."""
        if self._actual_kind != self._kind:
            return f"no: the autopilot says it is {self._actual_kind}, [autopilot] kind is {self._kind}"
        report = self._report
        if report is None or now_ns - report[0] > MAX_STATUS_AGE_NS:
            return "unknown: the autopilot does not report its estimator's status"
        _, flags, ratios = report
        worst = max((ratio for ratio in ratios if math.isfinite(ratio)), default=math.nan)
        objections = (
            (not flags & dialect.ESTIMATOR_ATTITUDE, "its estimator is not initialised"),
            (flags & dialect.ESTIMATOR_CONST_POS_MODE, "it assumes a constant position"),
            (not flags & HAS_POSITION, "it has no horizontal position"),
            (self._uses_external is False, "it reported that it stopped aiding"),
            (worst >= GATE, f"it rejects measurements, worst test ratio {worst:.2f}"),
        )
        found = next((text for applies, text in objections if applies), None)
        if found:
            return f"no: {found}"
        if self._uses_external:
            return f"yes: it reports so; worst test ratio {worst:.2f}"
        return f"likely: it has a position, worst test ratio {worst:.2f}; it does not report from which source"


class AutopilotOutput:
    """[autopilot]. `rate_hz` may be changed while it runs."""

    name = "autopilot"

    def __init__(
        self, config: Config, link: MavlinkLink, now: Callable[[], int], kept: KeptFrame | None = None
    ) -> None:
        """`kept` is the local frame of the last run."""
        self._settings, self._configured_geoid_m = config.autopilot, config.vehicle.geoid_m
        self._link, self._now = link, now
        self._conventions = CONVENTIONS[self._settings.kind]
        self.outbox = Outbox(OUTBOX, (StateMessage,))
        self.about = f"{self._settings.message} to {self._settings.kind} over MAVLink {self._settings.link}"
        self.limiter, self._max_hz = RateLimiter(self._settings.rate_hz), config.publish.rate_hz
        self.readback = Readback(link, self._settings.kind)
        self.frame = SharedFrame(KeptFrame() if kept is None else kept, self._conventions.project, now())
        self._counts = dict.fromkeys(("sent", "not fit", "stale", "link closed or full"), 0)
        self._unfit: tuple[str, str] | None = ("none", "no state yet")
        self._passed = True  # the link accepted the last one
        self._reported = "none"  # kind of reason in the last STATUSTEXT
        self._texts, self._next_text_ns, self._next_origin_ns, self._ask_origin_ns = 0, 0, 0, 0

    def session(self, stop: Event) -> None:
        """Send states until `stop` is set. The link's input opens and closes it; states while it is closed are lost and
        counted."""
        self._link.listeners.append(self.readback.receive)
        try:
            while not stop.is_set():
                self.ask_for_origin()
                for message in self.outbox.take(POLL_S):
                    if isinstance(message, StateMessage):
                        self.offer(message)
        finally:
            self._link.listeners.remove(self.readback.receive)

    def offer(self, message: StateMessage) -> None:
        """Send a state if it is fit and due; otherwise report why not."""
        if self._now() - message.t_ns > MAX_AGE_NS:
            self._counts["stale"] += 1
            return
        self._unfit = unfit(message, self._settings)
        self._report(message.t_ns)
        if not self.limiter.due(message.t_ns):
            return
        if self._unfit or message.state is None:
            self._counts["not fit"] += 1
            return
        origin = self.frame.at(message.state, self.readback.origin, self._geoid_m)
        if self._settings.set_origin and self.readback.origin is None and message.t_ns >= self._next_origin_ns:
            self._next_origin_ns = message.t_ns + ORIGIN_NS
            self._link.send(set_origin(message, origin, self._geoid_m, (self._link.housekeeping.target or (0, 0))[0]))
        self._passed = self._link.send(self._packed(message, message.state, origin))
        self._counts["sent" if self._passed else "link closed or full"] += 1

    def ask_for_origin(self) -> None:
        """Request GPS_GLOBAL_ORIGIN when that is due. An autopilot without an origin does not send it."""
        target, now = self._link.housekeeping.target, self._now()
        if target is None or self._settings.message == "gps_input" or now < self._ask_origin_ns:
            return
        self._ask_origin_ns = now + (ORIGIN_NS if self.readback.origin is None else ORIGIN_AGAIN_NS)
        self._link.send(dialect.MAVLink_command_long_message(
            *target, dialect.MAV_CMD_REQUEST_MESSAGE, 0, dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, 0, 0, 0, 0, 0, 0,
        ))  # fmt: skip

    @property
    def _geoid_m(self) -> float:
        """Height of the geoid above the ellipsoid: as configured, or else by the autopilot's receiver."""
        return self._configured_geoid_m or self.readback.undulation_m

    def _packed(self, message: StateMessage, state: State, origin: Origin) -> Any:
        if self._settings.message == "gps_input":
            return gps_input(message, state, self._geoid_m, self._settings.gps_id)
        if self._settings.message == "vision_position":
            return vision_position(message, state, origin, self._conventions, self.frame.count(message.resets))
        worth = quality(state, self._settings)
        return odometry(message, state, origin, self._conventions, worth, self.frame.count(message.resets))

    def _report(self, t_ns: int) -> None:
        """Report by STATUSTEXT whether states are sent from now on, at most once in TEXT_NS."""
        word = self._unfit[0] if self._unfit else ""
        if word == self._reported or t_ns < self._next_text_ns:
            return
        text = f"fusiond: not sent to the autopilot: {self._unfit[1]}" if self._unfit else "fusiond: sent to the autopilot"
        severity = dialect.MAV_SEVERITY_WARNING if self._unfit else dialect.MAV_SEVERITY_INFO
        self._texts = self._texts % 0xFFFF + 1
        if all(self._link.send(chunk) for chunk in status_texts(severity, text, self._texts)):
            self._reported = word
            self._next_text_ns = t_ns + TEXT_NS

    def parameter(self) -> Parameter:
        """Its rate, as a parameter for a ground station."""
        return Parameter("AP_RATE_HZ", lambda: self.limiter.rate_hz, self._set_rate, MIN_HZ, self._max_hz)

    def _set_rate(self, rate_hz: float) -> None:
        self.limiter.rate_hz = rate_hz

    def counts(self) -> dict[str, int]:
        """Counts of the states that were due; `not fit` are those that must not be sent."""
        return dict(self._counts)

    def notes(self) -> dict[str, str]:
        """Whether states are sent, whether the autopilot uses them, and whose origin their local frame has."""
        unfit_now = self._unfit
        reason = unfit_now[1] if unfit_now else "" if self._passed else "the link is closed or full"
        notes = {"sending": f"no: {reason}" if reason else "yes", "used": self.readback.verdict(self._now())}
        if self.frame.origin is not None and self._settings.message != "gps_input":
            notes["origin"] = "the autopilot's" if self.frame.is_reported else "our own: the autopilot reports none"
        return notes
