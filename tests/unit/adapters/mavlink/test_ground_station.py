"""Telemetry for a ground station: numbers, texts, answers, heartbeats that stop with the estimator, the marker."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import Any

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from fusiond.estimator.solution import Mode
from fusiond.maths.rotation import matrix
from fusiond.maths.wgs84 import ecef, mat_ne
from fusiond.messages.types import (
    EventMessage,
    HealthMessage,
    LatencyHealth,
    OutcomeCounts,
    Severity,
    SourceHealth,
    State,
)
from fusiond.ports.outputs import OutputLost
from fusiond_adapters.mavlink.ground_station import GroundStation, ratios
from fusiond_adapters.mavlink.outgoing import status_texts
from tests.helpers.ground_station import GET, GLOBAL, MARKER, STREAMS, from_station, long, settings_for, station_at
from tests.helpers.live import Autopilot, configuration, running
from tests.helpers.mavlink_peers import (
    CLOCK,
    MS,
    SYSTEM,
    Endpoint,
    TcpPeer,
    UdpListener,
    UdpPeer,
    greeted,
    link_to,
    recent,
    serving,
    state_at,
)


@pytest.fixture
def peer() -> Iterator[UdpListener]:
    made = UdpListener()
    yield made
    made.close()


@pytest.fixture
def vehicle() -> Iterator[UdpPeer]:
    made = UdpPeer()
    yield made
    made.close()


def event(text: str, severity: Severity = "warning") -> EventMessage:
    return EventMessage(vehicle="test", t_ns=0, kind="source_lost", severity=severity, subject="gps0", text=text)


# --- Numbers


def test_the_ground_station_gets_the_state(peer: UdpListener, tmp_path: Path) -> None:
    station, _ = station_at(peer.connection, tmp_path)
    states = recent(6)
    endpoint = from_station(peer)
    with serving(station):
        for message in states:
            station.outbox.put(message)
        endpoint.until(lambda: len(endpoint.of(*STREAMS)) == 3 * len(states))
    assert states[0].state is not None
    for number, message in enumerate(states):
        place, local, attitude = (endpoint.of(name)[number] for name in STREAMS)
        assert {m.time_usec for m in (place, local, attitude)} == {message.t_ns // 1000}
        assert message.state is not None
        check_place(place, message.state, states[0].state)
        check_local(local, message.state, states[0].state)
        assert attitude.q == pytest.approx(message.state.quaternion_nb, abs=1e-6)
        rates = attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed
        assert rates == pytest.approx(message.state.angular_rate_b_rps, abs=1e-7)
    assert not endpoint.of("GLOBAL_POSITION_INT", "GPS_RAW_INT", "BAD_DATA")


def check_place(m: Any, state: State, first: State) -> None:
    assert (m.lat / 1e7, m.lon / 1e7) == pytest.approx((state.lat_deg, state.lon_deg), abs=6e-8)
    assert m.alt == pytest.approx((state.height_m - 47.5) * 1e3, abs=1)
    assert m.relative_alt == pytest.approx((state.height_m - first.height_m) * 1e3, abs=1)
    assert (m.vx, m.vy, m.vz) == pytest.approx(state.velocity_ned_mps, rel=1e-6)
    position, velocity = np.array((state.covariance_position_m2, state.covariance_velocity_m2ps2)).reshape(2, 3, 3)
    got = np.array(m.covariance).reshape(6, 6)
    assert np.diag(got) == pytest.approx([*np.diag(position), *np.diag(velocity)], rel=1e-6)
    assert got[0, 2] == pytest.approx(-position[0, 2], rel=1e-6)  # up, not down
    assert got[0, 1] == pytest.approx(position[0, 1], rel=1e-6)


def check_local(m: Any, state: State, first: State) -> None:
    before, after = (
        ecef(math.radians(s.lat_deg), math.radians(s.lon_deg), s.height_m) for s in (first, state)
    )
    tangent = mat_ne(before) @ (after - before)
    assert (m.x, m.y, m.z) == pytest.approx(tangent, abs=0.05)  # so near, the Earth is flat
    whole = np.zeros((9, 9))
    whole[np.triu_indices(9)] = m.covariance
    assert np.diag(whole)[:3] == pytest.approx(np.square(state.sigma_position_ned_m), rel=1e-6)
    assert sum(np.diag(whole)[6:]) == pytest.approx(sum(np.square(state.sigma_accel_bias_mps2)), rel=1e-6)
    force_n = matrix(np.array(state.quaternion_nb)) @ state.acceleration_b_mps2
    assert (m.ax, m.ay) == pytest.approx(force_n[:2], abs=1e-5)
    assert m.az == pytest.approx(force_n[2] + 9.8075, abs=2e-3)


def test_estimator_status_has_ratios_and_whether_there_is_a_position(peer: UdpListener, tmp_path: Path) -> None:
    station, _ = station_at(peer.connection, tmp_path)
    endpoint = from_station(peer)
    counts = OutcomeCounts()
    judged = {"gps0.position": 0.25, "gps0.velocity": 0.04, "left": 0.81, "right": None}
    sources = {name: SourceHealth(outcomes=counts, present=True, test_ratio=value) for name, value in judged.items()}
    sources["right"] = SourceHealth(outcomes=counts, present=False, test_ratio=9.0)
    health = HealthMessage(vehicle="test", t_ns=0, version="", uptime_s=1.0, mode=Mode.NOMINAL, resets=0, outcomes=counts,
                           latency_ms=LatencyHealth(), sources=sources, inputs={}, outputs={})  # fmt: skip
    good, lost = state_at(CLOCK.now_ns() - 2000 * MS), state_at(CLOCK.now_ns(), mode=Mode.LOST)
    with serving(station):
        for message in (health, good, lost):
            station.outbox.put(message)
        endpoint.until(lambda: len(endpoint.of("ESTIMATOR_STATUS")) == 2)
    first, second = endpoint.of("ESTIMATOR_STATUS")
    assert (first.vel_ratio, first.pos_horiz_ratio, first.pos_vert_ratio) == pytest.approx((0.9, 0.5, 0.5))
    assert math.isnan(first.mag_ratio)
    assert good.state is not None
    north, east, down = good.state.sigma_position_ned_m
    assert (first.pos_horiz_accuracy, first.pos_vert_accuracy) == pytest.approx((math.hypot(north, east), down))
    absolute = common.ESTIMATOR_POS_HORIZ_ABS
    assert first.flags & absolute and not second.flags & absolute
    assert len(endpoint.of("GLOBAL_POSITION_INT_COV")) == 1  # none of the lost one
    assert all(map(math.isnan, ratios(msgspec.structs.replace(health, sources={}), settings_for(peer.connection, tmp_path))))


# --- Texts


@pytest.mark.parametrize("length", [1, 49, 50, 51, 99, 100, 101, 250])
def test_texts_survive_their_chunks(length: int) -> None:
    text = "".join(chr(33 + number % 90) for number in range(length))
    chunks = list(status_texts(4, text, 9))
    assert [chunk.chunk_seq for chunk in chunks] == list(range(len(chunks)))
    assert {chunk.id for chunk in chunks} == {0 if length <= 50 else 9}
    sender, parser = common.MAVLink(None), common.MAVLink(None)
    read = [parser.decode(bytearray(chunk.pack(sender))).text for chunk in chunks]
    assert "".join(read) == text
    assert length <= 50 or [len(part) == 50 for part in read] == [True] * (len(read) - 1) + [False]


def test_events_are_sent_as_texts(peer: UdpListener, tmp_path: Path) -> None:
    station, _ = station_at(peer.connection, tmp_path)
    endpoint = from_station(peer)
    long = "gps0.position has been silent for 12.5 s; the last fix was rejected, and before that came 14 which were fused"
    with serving(station):
        for message in (event("mode: aligning -> nominal", "info"), event(long), event("left slips", "critical")):
            station.outbox.put(message)
        endpoint.until(lambda: len(endpoint.texts()) == 3)
    assert endpoint.texts() == ["fusiond: mode: aligning -> nominal", f"fusiond: {long}", "fusiond: left slips"]
    assert [m.severity for m in endpoint.of("STATUSTEXT") if m.chunk_seq == 0] == [6, 4, 2]


# --- Heartbeats and the marker


def test_heartbeats_stop_when_the_estimator_does(peer: UdpListener, tmp_path: Path) -> None:
    station, now = station_at(peer.connection, tmp_path, f"marker_system = {MARKER}\n")
    endpoint = from_station(peer)
    with serving(station):
        station.outbox.put(state_at(now()))
        endpoint.until(lambda: len(endpoint.of("HEARTBEAT")) == 2)
        now.ahead_ns += 3 * 10**9  # no state for three seconds
        for turn in (1, 2):  # a heartbeat after the first answers would have come before the second
            endpoint.send(common.MAVLink_param_request_list_message(SYSTEM, 191))
            endpoint.until(lambda turn=turn: len(endpoint.of("PARAM_VALUE")) == 3 * turn)
        assert len(endpoint.of("HEARTBEAT")) == 2
        station.outbox.put(state_at(now()))
        endpoint.until(lambda: len(endpoint.of("HEARTBEAT")) == 4)
    ours, mark = endpoint.of("HEARTBEAT")[:2]
    assert (ours.get_srcSystem(), ours.get_srcComponent(), ours.type, ours.autopilot) == (SYSTEM, 191, 18, 8)
    assert (mark.get_srcSystem(), mark.get_srcComponent(), mark.type) == (MARKER, 1, common.MAV_TYPE_GROUND_ROVER)


def test_only_the_marker_has_the_position_of_a_vehicle(peer: UdpListener, tmp_path: Path) -> None:
    station, now = station_at(peer.connection, tmp_path, f"marker_system = {MARKER}\n")
    endpoint = from_station(peer)
    state = state_at(now(), 3)
    with serving(station):
        station.outbox.put(state)
        endpoint.until(lambda: bool(endpoint.of("GLOBAL_POSITION_INT")))
        arm = common.MAV_CMD_COMPONENT_ARM_DISARM
        endpoint.send(common.MAVLink_command_long_message(MARKER, 1, arm, 0, 1, 0, 0, 0, 0, 0, 0))
        endpoint.until(lambda: bool(endpoint.of("COMMAND_ACK")))
    (mark,) = endpoint.of("GLOBAL_POSITION_INT")
    assert state.state is not None
    assert mark.get_srcSystem() == MARKER and mark.hdg == round(state.state.yaw_deg % 360 * 100)
    assert (mark.lat, mark.lon) == (round(state.state.lat_deg * 1e7), round(state.state.lon_deg * 1e7))
    (answer,) = endpoint.of("COMMAND_ACK")
    assert (answer.get_srcSystem(), answer.result) == (MARKER, common.MAV_RESULT_UNSUPPORTED)


# --- Commands


# --- Parameters


# --- Its ways


def test_over_the_link_of_an_input(vehicle: UdpPeer, tmp_path: Path) -> None:
    settings, link = link_to(vehicle, tmp_path, '[ground_station]\nlink = "fc"\nrate_hz = 25.0\n')
    station = GroundStation(settings, {"mavlink.fc": link}, CLOCK.now_ns)
    endpoint = Endpoint(vehicle)
    with serving(link, station):
        greeted(endpoint, link)
        for state in recent(4):
            station.outbox.put(state)
        endpoint.until(lambda: len(endpoint.of(*STREAMS)) == 12)
        endpoint.send(long(GET, GLOBAL))
        endpoint.until(lambda: bool(endpoint.of("MESSAGE_INTERVAL")))
    assert {m.get_srcSystem() for m in endpoint.messages} == {SYSTEM}
    numbers = [m.get_seq() for m in endpoint.messages if m.get_srcComponent() == 191]
    assert numbers == [(numbers[0] + step) % 256 for step in range(len(numbers))]  # one counter, whoever speaks
    assert link.listeners == []


def test_a_connection_that_goes_is_an_output_lost(tmp_path: Path) -> None:
    peer = TcpPeer()
    station, now = station_at(peer.connection, tmp_path)
    station.outbox.put(state_at(now()))
    found: list[str] = []

    class Session:
        def session(self, stop: Event) -> None:
            with pytest.raises(OutputLost) as caught:
                station.session(stop)
            found.append(str(caught.value))

    with serving(Session()):
        endpoint = Endpoint(peer)
        endpoint.until(lambda: bool(endpoint.of("HEARTBEAT")))
        peer.close()
        while not found:
            station.outbox.put(state_at(now()))
            Event().wait(0.01)
    assert found[0].startswith("lost: ")
    with pytest.raises(OutputLost, match="cannot be opened"):
        station.session(Event())


# --- All of it, in the daemon


def test_the_daemon_feeds_autopilot_and_ground_station(vehicle: UdpPeer, peer: UdpListener, tmp_path: Path) -> None:
    """At rest, with a given heading that nothing confirms."""
    settings = configuration(
        tmp_path, vehicle.connection,
        f'[autopilot]\nlink = "fc"\nunconfirmed_heading = true\n'
        f'yaw_sigma_deg = 30.0\nposition_sigma_m = 50.0\nvelocity_sigma_mps = 50.0\n'
        f'[ground_station]\nconnection = "{peer.connection}"\nrate_hz = 50.0\n')  # fmt: skip
    autopilot, endpoint, station = Autopilot(), Endpoint(vehicle), from_station(peer)

    def turn() -> bool:
        vehicle.send(autopilot.heartbeat() + autopilot.imu())
        vehicle.send(autopilot.gps())
        station.listen()
        return len(endpoint.of("ODOMETRY")) > 5 and len(station.of("GLOBAL_POSITION_INT_COV")) > 5 and bool(station.texts())

    with running(settings) as run:
        endpoint.until(turn)
        published = [m for m in run.messages if m.state is not None]
        notes = run.daemon.outputs["autopilot"].notes()
    by_time = {m.t_ns // 1000: m for m in published}
    for m in endpoint.of("ODOMETRY")[:5]:
        state = by_time[m.time_usec].state
        assert state is not None and m.q == pytest.approx(state.quaternion_nb, abs=1e-6)
    place = station.of("GLOBAL_POSITION_INT_COV")[0]
    state = by_time[place.time_usec].state
    assert state is not None and place.lat == round(state.lat_deg * 1e7)
    assert notes["sending"] == "yes" and notes["used"].startswith("unknown")
