"""What a report shows, gathered during the replay in bounded memory: states, innovations, latencies, health, events."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from fusiond.app.replay.comparison import Errors
from fusiond.app.report.envelope import CAPACITY, Envelope, Spans
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Receipt
from fusiond.filter.rows import Outcome
from fusiond.maths.statistics import chi_square
from fusiond.messages.types import EventMessage, HealthMessage, InnovationMessage, Message, State, StateMessage
from fusiond.units import MILLISECOND, SECOND

AXES = 3  # of an innovation at the most
MAX_EVENTS = 1000
MAX_REJECTED = 600  # points of each source that are marked one by one
SLOW = 700  # spans of what changes slowly: calibration, clocks

STATE = (
    "north_sigma", "east_sigma", "down_sigma", "velocity_sigma", "heading_sigma",
    "speed", "climb", "height", "roll", "pitch", "heading",
    "acceleration_x", "acceleration_y", "acceleration_z", "rate_x", "rate_y", "rate_z",
    "gyro_bias_x", "gyro_bias_y", "gyro_bias_z", "gyro_bias_sigma",
    "accel_bias_x", "accel_bias_y", "accel_bias_z", "accel_bias_sigma",
)  # fmt: skip
ERRORS = ("north_error", "east_error", "height_error", "velocity_error", "heading_error")
UNKNOWN_ERRORS = (math.nan,) * len(ERRORS)
INNOVATION = ("first", "second", "third", "first_gate", "second_gate", "third_gate", "ratio")
CLOCK = ("offset", "drift", "jitter")
CALIBRATION = ("value", "sigma")
LATENCY = ("latency",)
CONSISTENCY = ("nis",)


class Gathered:
    """The sinks of one replay. `origin_ns` returns the instant of its first event on the present time line."""

    def __init__(self, config: Config, origin_ns: Callable[[], int]) -> None:
        self._origin_ns = origin_ns
        self._gates = [math.inf, *(chi_square(config.filter.gate_probability, axes) for axes in range(1, AXES + 1))]
        self.state = Envelope((*STATE, *ERRORS))
        self.modes = Spans()
        self.innovations: dict[str, Envelope] = {}  # by source
        self.rejected: dict[str, Envelope] = {}
        self.models: Mapping[str, str] = {}  # what each source measures
        self.axes: dict[str, int] = {}  # of the innovations of a source
        self.latencies: dict[str, Envelope] = {}
        self.consistencies: dict[str, Envelope] = {}
        self.statuses: dict[str, Spans] = {}
        self.clocks: dict[str, Envelope] = {}
        self.calibrations: dict[str, Envelope] = {}
        self.events: list[tuple[float, EventMessage]] = []  # second and event
        self.further_events = 0
        self.health: HealthMessage | None = None
        self.distance_m = 0.0
        self._last: tuple[int, float] | None = None  # instant and speed of the last state

    # --- Sinks

    def add_tick(self, message: StateMessage, errors: Errors | None) -> None:
        """A published state."""
        since_ns = message.t_ns - self._origin_ns()
        self.modes.add(since_ns, message.mode.value, message.fault or "")
        state = message.state
        if state is None:
            self._last = None
            return
        speed = math.hypot(*state.velocity_ned_mps[:2])
        if self._last and since_ns > self._last[0]:
            self.distance_m += (since_ns - self._last[0]) / SECOND * (speed + self._last[1]) / 2
        self._last = since_ns, speed
        self.state.add(since_ns, (*_state_row(state, speed), *(_error_row(errors) if errors else UNKNOWN_ERRORS)))

    def add_receipt(self, receipt: Receipt) -> None:
        """A measurement received: how late it was."""
        measurement = receipt.measurement
        if receipt.refusal is not Outcome.INVALID:
            late_ms = (measurement.t_receive_ns - measurement.t_ns) / MILLISECOND
            since_ns = measurement.t_receive_ns - self._origin_ns()
            _of(self.latencies, measurement.source, LATENCY).add(since_ns, (late_ms,))

    def add_message(self, message: Message) -> None:
        """Any other message that is published."""
        if isinstance(message, InnovationMessage):
            self._add_innovation(message)
        elif isinstance(message, HealthMessage):
            self._add_health(message)
        elif isinstance(message, EventMessage):
            if len(self.events) < MAX_EVENTS:
                self.events.append(((message.t_ns - self._origin_ns()) / SECOND, message))
            else:
                self.further_events += 1

    def finish(self, since_ns: int, models: Mapping[str, str]) -> None:
        """The end of the replay, and what each source measures: the name of its observation model."""
        self.models = models
        for spans in (self.modes, *self.statuses.values()):
            spans.finish(since_ns)

    # --- Parts

    def _add_innovation(self, message: InnovationMessage) -> None:
        axes, since_ns, source = len(message.innovation), message.t_ns - self._origin_ns(), message.source
        if not axes:
            return
        self.axes[source] = max(axes, self.axes.get(source, 0))
        limit = self._gates[axes]
        gates = [math.sqrt(limit * variance) for variance in message.variance]
        ratio = math.nan if message.test_ratio is None else message.test_ratio
        row = (*_filled(message.innovation), *_filled(gates), ratio)
        _of(self.innovations, source, INNOVATION).add(since_ns, row)
        if message.outcome == "rejected":
            _of(self.rejected, source, INNOVATION[:AXES], MAX_REJECTED).add(since_ns, row[:AXES])

    def _add_health(self, message: HealthMessage) -> None:
        self.health, since_ns = message, message.t_ns - self._origin_ns()
        for name, source in message.sources.items():
            status = source.status or ("nominal" if source.present else "absent")
            self.statuses.setdefault(name, Spans()).add(since_ns, status, source.reason or "")
            if source.nis_mean:  # 0 where the horizon holds none of its measurements
                _of(self.consistencies, name, CONSISTENCY, SLOW).add(since_ns, (source.nis_mean,))
        for clock in {source.clock.name: source.clock for source in message.sources.values() if source.clock}.values():
            _of(self.clocks, clock.name, CLOCK, SLOW).add(since_ns, (clock.offset_ms, clock.drift_ppm, clock.jitter_ms))
        for name, learnt in message.calibration.items():
            _of(self.calibrations, name, CALIBRATION, SLOW).add(since_ns, (learnt.value, learnt.sigma))


def _of(where: dict[str, Envelope], name: str, columns: Sequence[str], capacity: int = CAPACITY) -> Envelope:
    """The curves of a name, begun where there are none yet."""
    if name not in where:
        where[name] = Envelope(columns, capacity)
    return where[name]


def _filled(values: Sequence[float]) -> tuple[float, ...]:
    """The values of all axes; nan for those that a source does not have."""
    return (*values, *(math.nan,) * (AXES - len(values)))


def _state_row(state: State, speed: float) -> tuple[float, ...]:
    north, east, down = state.sigma_position_ned_m
    turn = math.degrees(1.0)
    return (
        north, east, down, state.sigma_velocity_mps, state.sigma_yaw_deg,
        speed, -state.velocity_ned_mps[2], state.height_m, state.roll_deg, state.pitch_deg, state.yaw_deg % 360,
        *state.acceleration_b_mps2, *(rate * turn for rate in state.angular_rate_b_rps),
        *(bias * turn for bias in state.gyro_bias_rps), max(state.sigma_gyro_bias_rps) * turn,
        *state.accel_bias_mps2, max(state.sigma_accel_bias_mps2),
    )  # fmt: skip


def _error_row(errors: Errors) -> tuple[float, ...]:
    return errors.north_m, errors.east_m, errors.height_m, errors.velocity_mps, errors.yaw_deg
