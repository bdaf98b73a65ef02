"""Fusion of one vehicle: events in, outcomes and solutions out. Live and replay use it in the same way."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

from msgspec import Struct

from fusiond.config.schema import Config, Imu
from fusiond.estimator.history import History
from fusiond.estimator.solution import COVARIANCE_SIZE, Mode, Solution, SolutionState
from fusiond.events import ImuSample, Invalid, Measurement, Received, Vector3
from fusiond.filter.hot_start import is_confirmed, leading, leads
from fusiond.filter.kernel.interpreted import AnyKernel
from fusiond.filter.north_east_down import COVARIANCE_N, QUATERNION_NB, VELOCITY_N
from fusiond.filter.observations import IMU, MODELS
from fusiond.filter.observations.model import STAMP_ERROR, Unusable, within
from fusiond.filter.parameters import make_parameters, model_of
from fusiond.filter.rivals import probability_of_lie
from fusiond.filter.rows import Outcome
from fusiond.filter.source_health import Belief, belief
from fusiond.filter.state import (
    ACCEL_BIAS,
    ACCEL_BIAS_B,
    FORCE_B,
    GYRO_BIAS,
    GYRO_BIAS_B,
    HOT_START,
    MOUNT,
    MOUNT_ERROR,
    NEVER,
    PHASE,
    RATE_B,
    RESETS,
    RUNNING,
    SCALE,
    T_IMU,
    T_POSITION,
    T_START,
    WHEEL_SCALE,
    FilterState,
    T,
    Verdict,
)
from fusiond.filter.stored_state import StoredState, check, stored_state
from fusiond.maths.typed import Array
from fusiond.timeline.clock import Clock
from fusiond.units import SECOND, nanoseconds

LOST_IMU_NS = 5 * SECOND  # the mode is lost when the newest inertial sample is older than this


class Receipt(Struct, frozen=True, gc=False):
    """The outcome of an event that was received."""

    measurement: Measurement
    history: History
    refusal: Outcome | None = None  # INVALID, TOO_OLD or DUPLICATE; None if the event is in the history
    reason: str = ""  # why it is INVALID

    @property
    def outcome(self) -> Outcome:
        """The outcome so far: it can change when an earlier event arrives late. Reading it makes the history run the
        rows that are due. LookupError if the history has dropped the event, long after the horizon."""
        return self.history.outcome(self.measurement) if self.refusal is None else self.refusal


class Fusion:
    """Clock, history and filter of one vehicle, by its configuration."""

    def __init__(self, config: Config, compiled: bool | None = None, stored: StoredState | None = None) -> None:
        """`compiled` selects the compiled kernel or its NumPy twin; the default is the compiled one if it was built.
        `stored` is the state of an earlier run, for a hot start; StoredStateError if it does not fit the configuration."""
        if stored is not None:
            check(stored, config)
        self.config = config
        self.params = make_parameters(config, stored)
        self.clock = Clock(config)
        self.history = History(self.params, compiled)
        self._predicted = FilterState(len(self.params.sources), self.params.size)  # the head, predicted to an instant
        self._encoders: dict[str, tuple[Callable[[Any, Any], tuple[float, ...]], Any]] = {  # payload and section to numbers
            source: (imu_values if (model := model_of(found.stream)) == IMU else MODELS[model].values, found.section)
            for source, found in config.streams().items()
        }
        self.invalid: dict[str, Counter[str]] = {source: Counter() for source in self.params.sources}
        self._first_ns: int | None = None  # receipt of the session's first measurement

    def feed(self, received: Received) -> Receipt | None:
        """Align an event and fuse it; begin a new session if its receipt steps back. None for an event that only informs the
        clock.

        The source must be one of the configuration's; ValueError otherwise.
        """
        if self.clock.steps_back(received):
            self.begin_session()
        measurement = self.clock.align(received)
        return None if measurement is None else self.fuse(measurement)

    def fuse(self, measurement: Measurement) -> Receipt:
        """Fuse an event that is already aligned. ValueError if its source is not configured."""
        if self._first_ns is None:
            self._first_ns = measurement.t_receive_ns
        history, source = self.history, self.history.index.get(measurement.source)
        if source is None:
            raise ValueError(f"no source '{measurement.source}' is configured: {', '.join(self.params.sources)}")
        try:
            values = self._values(measurement)
        except Unusable as unusable:
            reason = str(unusable)
            self.invalid[measurement.source][reason] += 1
            return Receipt(measurement, history, history.count(source, Outcome.INVALID), reason)
        return Receipt(measurement, history, history.offer(source, measurement, values))

    def begin_session(self) -> None:
        """Begin anew on a time line that has stepped back: clocks and state align again; biases, calibrations and counts
        are kept."""
        self.clock.forget()
        self.history.finish()
        self.history = self.history.next_session()
        self._first_ns = None

    def solution_at(self, t_ns: int) -> Solution:
        """The solution at an instant, from everything received so far: the head, predicted to the instant with the newest
        IMU sample. An instant before the head's gives the head itself."""
        self._predicted.copy_from(self.history.head)
        state = self._published(self._predicted)
        self.history.kernel.predict(state, t_ns)
        return self._solution(state, t_ns)

    def settled(self) -> Solution:
        """The solution at the horizon, which no late event can change any more."""
        state = self._published(self.history.settled())
        self.history.kernel.predict(state, int(state.stamps[T]))
        return self._solution(state, int(state.stamps[T]))

    def hot_start(self) -> Verdict:
        """The result of checking the stored state."""
        return Verdict(int(self.history.head.stamps[HOT_START]))

    def to_store(self) -> StoredState | None:
        """The newest state, for a hot start of the next run; None before alignment is complete."""
        head = self.history.head
        if leads(head, self.params):
            head = leading(head)
        return stored_state(head, self.config) if head.stamps[PHASE] == RUNNING else None

    def outcomes(self) -> dict[str, dict[str, int]]:
        """Counts of outcomes by source. An event counts with its latest outcome."""
        return {
            source: {outcome.name: int(self.history.counts[i, outcome]) for outcome in Outcome}
            for i, source in enumerate(self.params.sources)
        }

    def totals(self) -> dict[str, int]:
        """Counts of outcomes over all sources."""
        return {outcome.name: int(self.history.counts[:, outcome].sum()) for outcome in Outcome}

    def health(self, t_ns: int) -> dict[str, Belief]:
        """The health of each source at an instant (docs/theory.md, D1 and D2). Until the filter runs, only a source that
        never came is absent."""
        head, came = self.history.head, self.history.counts.sum(axis=1) > 0
        start = int(head.stamps[T_START])
        first = t_ns if self._first_ns is None else self._first_ns
        return {
            source: belief(
                head.memory[i],
                head.source_stamps[i],
                t_ns,
                start if start != NEVER else t_ns if came[i] else first,
                probability_of_lie(head, i, self.params),
            )
            for i, source in enumerate(self.params.sources)
        }

    def _values(self, measurement: Measurement) -> tuple[float, ...]:
        """The numbers of a payload for the kernel. Raises Unusable."""
        payload = measurement.payload
        if isinstance(payload, Invalid):
            raise Unusable(payload.reason)
        to_values, section = self._encoders[measurement.source]
        values = to_values(payload, section)
        if not math.isfinite(sum(values)):
            raise Unusable("not finite")
        if measurement.stamp_sigma > 0:
            values += (0.0,) * (STAMP_ERROR - len(values)) + (measurement.stamp_sigma,)
        return values

    def _published(self, state: FilterState) -> FilterState:
        """The state to publish: the leading hypothesis where a bank is sure of a stored heading, else the state itself."""
        return leading(state) if leads(state, self.params) else state

    def _solution(self, state: FilterState, t_ns: int) -> Solution:
        """The solution that a filter state gives at an instant."""
        stamps, resets = state.stamps, int(state.stamps[RESETS])
        age = None if stamps[T_IMU] == NEVER else t_ns - int(stamps[T_IMU])
        if stamps[PHASE] != RUNNING:
            return Solution(t_ns, Mode.ALIGNING, age, resets, None, False)
        published = solution_state(state, self.history.kernel)
        north, east, _ = published.sigma_position_n()
        mode = Mode.NOMINAL
        if not math.hypot(north, east) <= self.params.filter.lost_sigma_m or age is None or age > LOST_IMU_NS:
            mode = Mode.LOST
        elif t_ns - int(stamps[T_POSITION]) > nanoseconds(self.params.filter.position_timeout_s):
            mode = Mode.DEAD_RECKONING
        return Solution(t_ns, mode, age, resets, published, is_confirmed(state))


def imu_values(sample: ImuSample, imu: Imu) -> tuple[float, ...]:
    """Specific force (3,) [m/s^2] and angular rate (3,) [rad/s]. Raises Unusable."""
    within(sample.specific_force_b, imu.accel_limit, "beyond the accelerometer's range")
    within(sample.angular_rate_b, imu.gyro_limit, "beyond the gyro's range")
    return sample.specific_force_b + sample.angular_rate_b


def solution_state(state: FilterState, kernel: AnyKernel) -> SolutionState:
    """A filter state after alignment, in north-east-down, for publication."""
    numbers = kernel.to_north_east_down(state.nominal, state.covariance)
    variances, auxiliary = state.covariance.diagonal(), state.auxiliary
    return to_solution(state.nominal, numbers, variances, auxiliary[RATE_B], auxiliary[FORCE_B])


def to_solution(nominal_e: Array, state_n: Array, variances: Array, rate_b: Array, force_b: Array) -> SolutionState:
    """A state for publication from its numbers: nominal, in north-east-down, variances (n,) of the error state, angular rate
    (3,) [rad/s] and specific force (3,) [m/s^2], bias included."""
    published, nominal = state_n[: COVARIANCE_N.start].tolist(), nominal_e.tolist()
    rate, force = rate_b.tolist(), force_b.tolist()
    gyro_bias, accel_bias = nominal[GYRO_BIAS_B], nominal[ACCEL_BIAS_B]
    sigma = [math.sqrt(max(variance, 0.0)) for variance in variances.tolist()]
    return SolutionState(
        latitude=published[0],
        longitude=published[1],
        height=published[2],
        velocity_n=_three(published[VELOCITY_N]),
        quaternion_nb=tuple(published[QUATERNION_NB]),
        angular_rate_b=(rate[0] - gyro_bias[0], rate[1] - gyro_bias[1], rate[2] - gyro_bias[2]),
        acceleration_b=(force[0] - accel_bias[0], force[1] - accel_bias[1], force[2] - accel_bias[2]),
        gyro_bias=_three(gyro_bias),
        accel_bias=_three(accel_bias),
        wheel_scale=nominal[WHEEL_SCALE.start],
        mount=(nominal[MOUNT.start], nominal[MOUNT.start + 1]),
        covariance=state_n[COVARIANCE_N].reshape(COVARIANCE_SIZE, COVARIANCE_SIZE),
        sigma_gyro_bias=_three(sigma[GYRO_BIAS]),
        sigma_accel_bias=_three(sigma[ACCEL_BIAS]),
        sigma_wheel_scale=sigma[SCALE.start],
        sigma_mount=(sigma[MOUNT_ERROR.start], sigma[MOUNT_ERROR.start + 1]),
    )


def _three(vector: list[float]) -> Vector3:
    x, y, z = vector
    return x, y, z
