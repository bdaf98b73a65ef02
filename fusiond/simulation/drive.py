"""A simulated drive: the truth, and every message as it was received.

`simulate` is a pure function of scenario and seed. Every random part draws from a generator of its own, and draws for
every sample whether or not a fault swallows it, so that a fault switched on leaves all other noise as it was.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fusiond.events import Received
from fusiond.maths.typed import Array
from fusiond.simulation import barometer, gnss, imu, wheels
from fusiond.simulation.chatter import FIRST_ID, TELEMETRY_HZ, traffic_rates
from fusiond.simulation.gnss import Fixes
from fusiond.simulation.scenario import WHEELS, Scenario, Transport
from fusiond.simulation.trajectory import Trajectory
from fusiond.simulation.transport import BootClock, Mask, Passage, Stamps, carry, within
from fusiond.simulation.truth import Truth, motion, quaternions
from fusiond.simulation.wire import (
    CanFrames,
    GnssMessages,
    Heartbeats,
    ImuMessages,
    PressureMessages,
    Telemetry,
    TimeMessages,
    WheelFrames,
)
from fusiond.units import MICROSECOND, MILLISECOND, SECOND, nanoseconds

# Offsets of the streams, so that their instants differ.
WHEEL_PHASE_S, STEERING_PHASE_S, SPEED_PHASE_S, BEACON_PHASE_S = 0.0013, 0.0027, 0.0041, 0.1
PRESSURE_PHASE_S = 0.0119
TELEMETRY_PHASE_S, TRAFFIC_PHASE_S = 0.0007, 0.00037  # of the first kind, and between each kind and the next
BEACON_SCATTER_S = 0.02  # SYSTEM_TIME and HEARTBEAT are sent when the autopilot's scheduler has time
GENERATORS = (
    *("imu_bias", "imu_noise", "imu_vibration", "gnss_white", "gnss_drift", "gnss_velocity"),
    *WHEELS,
    *("imu_link", "gnss_link", "time_link", "heartbeat_link", "wheels_link", "steering_link", "speed_link", "beacons"),
    *("telemetry_link", "traffic_link", "traffic_data"),
    *("pressure", "pressure_link", "gnss_quality"),
)


@dataclass(frozen=True, slots=True)
class Drive:
    """The result of `simulate`: the truth at the IMU's instants, and what was received, in the order of receipt."""

    scenario: Scenario
    seed: int
    truth: Truth
    imu: ImuMessages
    gnss: GnssMessages
    time: TimeMessages
    heartbeats: Heartbeats
    wheels: WheelFrames
    barometer: PressureMessages
    chatter: tuple[CanFrames, ...]
    telemetry: tuple[Telemetry, ...]

    def events(self) -> Iterator[Received]:
        """The events in the order of receipt, as the log readers decode them with the matching configuration."""
        streams = (
            self.imu.events(),
            self.gnss.events(),
            self.time.events(),
            self.wheels.events(),
            self.barometer.events(),
        )
        return heapq.merge(*streams, key=lambda event: event.t_receive_ns)


@dataclass(frozen=True, slots=True)
class _Sent:
    """The messages of one stream: when each was made, how it was carried, and whether its sender was running."""

    t_origin_ns: Stamps
    passage: Passage
    sent: Mask

    def receipt(self, host_offset_s: float) -> tuple[Stamps, Stamps]:
        """Which messages arrived, in order of receipt, and the microseconds of their receipt on the host's clock."""
        rows = np.flatnonzero(self.sent & self.passage.arrived)
        t_receive_ns = self.passage.t_receive_ns[rows] + nanoseconds(host_offset_s)
        order = np.argsort(t_receive_ns, kind="stable")
        return rows[order], t_receive_ns[order] // MICROSECOND


class _Simulation:
    """One run; the parts share the trajectory, the clocks and the generators."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario = scenario
        self.trajectory = Trajectory(scenario)
        self.clock = BootClock(scenario.autopilot, scenario.start_ns)
        children = np.random.SeedSequence(seed).spawn(len(GENERATORS))
        self.random = dict(zip(GENERATORS, map(np.random.default_rng, children), strict=True))

    def instants(self, rate_hz: float, phase_s: float) -> Array:
        """Regular times [s] inside the drive; none at a rate of 0."""
        if rate_hz == 0:
            return np.empty(0)
        count = max(0, int((self.trajectory.duration - phase_s) * rate_hz + 1e-6) + 1)
        return phase_s + np.arange(count) / rate_hz

    def unix(self, t: Array) -> Stamps:
        """True Unix time [ns] of times from the start [s]."""
        return self.scenario.start_ns + np.rint(t * SECOND).astype(np.int64)

    def send(self, t_origin_ns: Stamps, transport: Transport, link: str, awake: Mask) -> _Sent:
        return _Sent(t_origin_ns, carry(t_origin_ns, transport, self.random[link]), awake)

    def send_mavlink(self, t_origin_ns: Stamps, transport: Transport, link: str, awake: Mask | None = None) -> _Sent:
        running = self.clock.running(t_origin_ns)
        return self.send(t_origin_ns, transport, link, running if awake is None else running & awake)

    def frame_counters(self, streams: list[_Sent]) -> list[Stamps]:
        """The frame counter (0 to 255) that the link gave to each message of each stream, in the order of sending."""
        departures = np.concatenate([stream.passage.t_depart_ns for stream in streams])
        sent = np.concatenate([stream.sent for stream in streams])
        sessions = self.clock.session(np.concatenate([stream.t_origin_ns for stream in streams]))
        counters = np.zeros(len(sent), np.int64)
        for session in np.unique(sessions):
            rows = np.flatnonzero(sent & (sessions == session))
            counters[rows[np.argsort(departures[rows], kind="stable")]] = np.arange(len(rows)) % 256
        return np.split(counters, np.cumsum([len(stream.sent) for stream in streams])[:-1])


def simulate(scenario: Scenario, seed: int | None = None) -> Drive:
    """Drive the scenario; `seed` in place of the scenario's own."""
    chosen = scenario.seed if seed is None else seed
    run = _Simulation(scenario, chosen)
    truth, samples = _truth_and_imu(run)
    t_fix, t_beacon = _fix_instants(run), run.instants(1.0, BEACON_PHASE_S)
    t_beacon += run.random["beacons"].uniform(0, BEACON_SCATTER_S, len(t_beacon))
    white, drift, velocity, quality = (run.random[f"gnss_{name}"] for name in ("white", "drift", "velocity", "quality"))
    fixes = gnss.measure(scenario, run.trajectory, t_fix, (white, drift, velocity, quality))
    t_sample_ns, t_fix_ns, t_beacon_ns = run.unix(run.trajectory.t), run.unix(t_fix), run.unix(t_beacon)
    t_pressure = run.instants(scenario.barometer.rate_hz, PRESSURE_PHASE_S)
    t_pressure_ns, height = run.unix(t_pressure), np.interp(t_pressure, run.trajectory.t, truth.height)
    pressures = barometer.measure(scenario.barometer, height, run.random["pressure"])
    t_fix_arrival_ns = t_fix_ns + round(scenario.gnss.delay_ms * MILLISECOND)
    spoken = ~within(t_fix, scenario.gnss.outage_s)
    streams = [
        run.send_mavlink(
            t_sample_ns, scenario.imu.transport, "imu_link", ~within(run.trajectory.t, scenario.imu.silent_s)
        ),
        run.send_mavlink(t_fix_arrival_ns, scenario.gnss.transport, "gnss_link", spoken),
        run.send_mavlink(t_beacon_ns, scenario.autopilot.transport, "time_link"),
        run.send_mavlink(t_beacon_ns, scenario.autopilot.transport, "heartbeat_link"),
        run.send_mavlink(t_pressure_ns, scenario.barometer.transport, "pressure_link"),
    ]
    telemetry = _telemetry(run)
    counters = run.frame_counters([*streams, *telemetry.values()])
    (i, t_i), (g, t_g), (s, t_s), (h, t_h), (p, t_p) = (stream.receipt(scenario.host.offset_s) for stream in streams)
    stamps = {
        "unix": t_fix_ns // MICROSECOND,
        "boot-arrival": run.clock.read(t_fix_arrival_ns) // MICROSECOND,
        "none": np.zeros_like(t_fix_ns),
    }[scenario.gnss.stamp]
    return Drive(
        scenario=scenario,
        seed=chosen,
        truth=truth,
        imu=ImuMessages(
            t_receive_us=t_i,
            counter=counters[0][i],
            time_us=run.clock.read(t_sample_ns)[i] // MICROSECOND,
            specific_force_b=samples[0][i].astype(np.float32),
            angular_rate_b=samples[1][i].astype(np.float32),
        ),
        gnss=GnssMessages(t_g, counters[1][g], stamps[g], _rows(fixes, g)),
        time=TimeMessages(t_s, counters[2][s], t_beacon_ns[s] // MICROSECOND, run.clock.read(t_beacon_ns)[s] // MILLISECOND),
        heartbeats=Heartbeats(t_h, counters[3][h]),
        wheels=_wheel_frames(run),
        barometer=PressureMessages(t_p, counters[4][p], run.clock.read(t_pressure_ns)[p] // MILLISECOND, pressures[p]),
        chatter=(*(_chatter(run) if scenario.wheels.chatter else ()), *_traffic(run)),
        telemetry=tuple(
            _received(run, message, sent, counter)
            for (message, sent), counter in zip(telemetry.items(), counters[len(streams) :], strict=True)
        ),
    )


def _truth_and_imu(run: _Simulation) -> tuple[Truth, tuple[Array, Array]]:
    """The truth, and the readings (N, 3) of accelerometer and gyro."""
    scenario, trajectory = run.scenario, run.trajectory
    true = motion(trajectory)
    generators = (run.random["imu_bias"], run.random["imu_noise"], run.random["imu_vibration"])
    gyro, accel, gyro_bias, accel_bias = imu.measure(scenario.imu, trajectory.t, true, generators)
    truth = Truth(
        t_ns=run.unix(trajectory.t) + nanoseconds(scenario.host.offset_s),
        latitude=true.position[0],
        longitude=true.position[1],
        height=true.position[2],
        velocity_n=true.velocity_n,
        quaternion_nb=quaternions(true.euler),
        euler=true.euler,
        angular_rate_b=true.angular_rate_b,
        specific_force_b=true.specific_force_b,
        gyro_bias_b=gyro_bias,
        accel_bias_b=accel_bias,
        speed=true.speed,
        wheel_scale=wheels.scales(scenario.wheels),
    )
    return truth, (accel, gyro)


def _telemetry(run: _Simulation) -> dict[str, _Sent]:
    """Other messages of the autopilot, if the scenario has them."""
    if not run.scenario.autopilot.telemetry:
        return {}
    found = {}
    for number, (message, rate_hz) in enumerate(TELEMETRY_HZ.items(), 1):
        t_ns = run.unix(run.instants(rate_hz, number * TELEMETRY_PHASE_S))
        found[message] = run.send_mavlink(t_ns, run.scenario.imu.transport, "telemetry_link")
    return found


def _received(run: _Simulation, message: str, sent: _Sent, counters: Stamps) -> Telemetry:
    rows, t_receive_us = sent.receipt(run.scenario.host.offset_s)
    since_s = (sent.t_origin_ns - run.scenario.start_ns) / SECOND
    instants = np.minimum((since_s * run.scenario.imu.rate_hz).astype(np.int64), len(run.trajectory.t) - 1)
    boot_ms = run.clock.read(sent.t_origin_ns) // MILLISECOND
    return Telemetry(message, t_receive_us, counters[rows], boot_ms[rows], instants[rows])


def _fix_instants(run: _Simulation) -> Array:
    """Receivers fix at whole multiples of their interval in Unix time."""
    rate = run.scenario.gnss.rate_hz
    into_second = run.scenario.start_ns % SECOND / SECOND
    return run.instants(rate, float(np.ceil(into_second * rate - 1e-6) / rate - into_second))


def _rows(fixes: Fixes, rows: Stamps) -> Fixes:
    return replace(
        fixes,
        fix_type=fixes.fix_type[rows],
        lat=fixes.lat[rows],
        lon=fixes.lon[rows],
        alt=fixes.alt[rows],
        alt_ellipsoid=fixes.alt_ellipsoid[rows],
        vel=fixes.vel[rows],
        cog=fixes.cog[rows],
        h_acc=fixes.h_acc[rows],
        v_acc=fixes.v_acc[rows],
    )


def _wheel_frames(run: _Simulation) -> WheelFrames:
    scenario = run.scenario
    t = run.instants(scenario.wheels.rate_hz, WHEEL_PHASE_S)
    generators = [run.random[name] for name in WHEELS]
    raw, fault = wheels.measure(scenario, t, run.trajectory.kinematics(t), generators)
    spoken = ~within(t, scenario.wheels.silent_s)
    counter = np.maximum(np.cumsum(spoken) - 1, 0) % (1 << wheels.COUNTER_BITS)
    sent = run.send(run.unix(t), scenario.wheels.transport, "wheels_link", spoken)
    rows, t_receive_us = sent.receipt(scenario.host.offset_s)
    return WheelFrames(t_receive_us, raw[rows], fault[rows], counter[rows], scenario.wheels.resolution_kmh)


def _chatter(run: _Simulation) -> tuple[CanFrames, ...]:
    """Frames of no use to the filter, as any bus is full of."""
    found = []
    for identifier, rate_hz, phase_s, link in (
        (wheels.STEERING_ID, wheels.STEERING_HZ, STEERING_PHASE_S, "steering_link"),
        (wheels.SPEED_ID, wheels.SPEED_HZ, SPEED_PHASE_S, "speed_link"),
    ):
        t = run.instants(rate_hz, phase_s)
        kinematics = run.trajectory.kinematics(t)
        steers = identifier == wheels.STEERING_ID
        data = wheels.steering_frames(run.scenario, kinematics) if steers else wheels.speed_frames(kinematics)
        sent = run.send(run.unix(t), run.scenario.wheels.transport, link, np.ones(len(t), np.bool_))
        rows, t_receive_us = sent.receipt(run.scenario.host.offset_s)
        found.append(CanFrames(identifier, t_receive_us, data[rows]))
    return tuple(found)


def _traffic(run: _Simulation) -> Iterator[CanFrames]:
    """Frames of further ids, full of anything."""
    for number, rate_hz in enumerate(traffic_rates(run.scenario.wheels.traffic_hz)):
        t = run.instants(rate_hz, (number + 1) * TRAFFIC_PHASE_S)
        data = run.random["traffic_data"].integers(0, 1 << 64, len(t), np.uint64)
        sent = run.send(run.unix(t), run.scenario.wheels.transport, "traffic_link", np.ones(len(t), np.bool_))
        rows, t_receive_us = sent.receipt(run.scenario.host.offset_s)
        yield CanFrames(FIRST_ID + number, t_receive_us, data[rows])
