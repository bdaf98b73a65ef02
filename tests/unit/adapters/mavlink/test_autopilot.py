"""The state to the autopilot: what ArduPilot and PX4 make of it, what is never sent, and whether they use it."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fusiond.config.schema import Config
from fusiond.estimator.solution import Mode
from fusiond.maths.rotation import euler, matrix
from fusiond.messages.types import State, StateMessage
from fusiond.ports.outputs import KeptFrame
from fusiond_adapters.mavlink.autopilot import AutopilotOutput, Readback
from fusiond_adapters.mavlink.outgoing import CONVENTIONS, Origin, odometry
from tests.helpers.live import configuration
from tests.helpers.mavlink_peers import (
    CLOCK,
    COMPONENT,
    MS,
    SYSTEM,
    ArduPilot,
    Endpoint,
    Peer,
    Px4,
    Recorder,
    TcpPeer,
    UdpPeer,
    greeted,
    link_to,
    recent,
    serving,
    state_at,
    state_of,
)

ON = '[autopilot]\nlink = "fc"\nrate_hz = 25.0\n'
AUTOPILOTS: dict[str, type[ArduPilot] | type[Px4]] = {"ardupilot": ArduPilot, "px4": Px4}


@pytest.fixture(params=[UdpPeer, TcpPeer], ids=["udp", "tcp"])
def peer(request: pytest.FixtureRequest) -> Iterator[Peer]:
    made: Peer = request.param()
    yield made
    made.close()


@pytest.fixture
def udp() -> Iterator[UdpPeer]:
    made = UdpPeer()
    yield made
    made.close()


def position_of(state: StateMessage) -> tuple[float, float, float]:
    return state_of(state).lat_deg, state_of(state).lon_deg, state_of(state).height_m


def diagonal(block: tuple[float, ...]) -> list[float]:
    return [block[0], block[4], block[8]]


# --- What they make of it


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
@pytest.mark.parametrize("message", ["odometry", "vision_position"])
def test_the_autopilot_gets_the_state(peer: Peer, kind: str, message: str, tmp_path: Path) -> None:
    settings, link = link_to(peer, tmp_path, f'{ON}kind = "{kind}"\nmessage = "{message}"\n')
    output = AutopilotOutput(settings, link, CLOCK.now_ns)
    states = recent(8, resets=259)
    endpoint = Endpoint(peer)
    names = ("ODOMETRY", "VISION_POSITION_ESTIMATE")
    maker = dialect.MAV_AUTOPILOT_PX4 if kind == "px4" else dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
    with serving(link, output):
        greeted(endpoint, link, maker)
        for state in states:
            output.outbox.put(state)
        endpoint.until(lambda: len(endpoint.of(*names)) == len(states))
    sent = endpoint.of(*names)
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in sent} == {(SYSTEM, 191)}
    autopilot = AUTOPILOTS[kind](position_of(states[0]))
    for m, state in zip(sent, states, strict=True):
        accepted = autopilot.accept(m)
        assert accepted is not None
        want = state_of(state)
        metre = 1e-5  # deg
        assert accepted.time_us == state.t_ns // 1000
        assert accepted.latitude_deg == pytest.approx(want.lat_deg, abs=1e-3 * metre)
        assert accepted.longitude_deg == pytest.approx(want.lon_deg, abs=1e-3 * metre)
        assert accepted.height_m == pytest.approx(want.height_m, abs=1e-5)
        assert accepted.quaternion is not None
        assert abs(np.dot(accepted.quaternion, want.quaternion_nb)) == pytest.approx(1, abs=1e-6)
        assert accepted.reset_counter == (output.frame.count(0) + 259) % 256
        if message == "odometry":
            assert accepted.velocity_n == pytest.approx(want.velocity_ned_mps, abs=1e-5)
            assert 1 <= accepted.quality <= 100
        check_variances(accepted.errors, want, kind)


def check_variances(variances: tuple[float, ...], want: State, kind: str) -> None:
    position = diagonal(want.covariance_position_m2)
    if kind == "ardupilot":
        assert variances[0] == pytest.approx(max(math.cbrt(sum(square**2 for square in position)), 0.2), rel=1e-5)
        return
    assert variances[:3] == pytest.approx(position, rel=1e-5)
    if len(variances) > 6:
        mat_bn = matrix(np.array(want.quaternion_nb)).T
        velocity = np.array(want.covariance_velocity_m2ps2).reshape(3, 3)
        assert variances[6:] == pytest.approx(np.diag(mat_bn @ velocity @ mat_bn.T), rel=1e-4)


def test_what_pleases_one_autopilot_is_refused_by_the_other() -> None:
    message = state_at(10**18, 3)
    origin = Origin.of(state_of(message))
    here = position_of(message)
    to_px4 = odometry(message, state_of(message), origin, CONVENTIONS["px4"], 50, 0)
    to_ardupilot = odometry(message, state_of(message), origin, CONVENTIONS["ardupilot"], 50, 0)
    ardupilot, px4 = ArduPilot(here), Px4(here)
    assert ardupilot.accept(to_px4) is None and ardupilot.dropped == 1
    assert px4.accept(to_ardupilot) is None and px4.refused == 1
    to_px4.estimator_type = dialect.MAV_ESTIMATOR_TYPE_GPS_INS
    assert px4.accept(to_px4) is None
    to_px4.estimator_type = dialect.MAV_ESTIMATOR_TYPE_NAIVE
    naive = px4.accept(to_px4)
    assert naive is not None and naive.errors == ()
    to_ardupilot.quality = -1
    assert ardupilot.accept(to_ardupilot) is None


def test_gps_input(udp: UdpPeer, tmp_path: Path) -> None:
    settings, link = link_to(udp, tmp_path, f'{ON}message = "gps_input"\ngps_id = 1\n')
    settings = msgspec.structs.replace(settings, vehicle=msgspec.structs.replace(settings.vehicle, geoid_m=47.5))
    output = AutopilotOutput(settings, link, CLOCK.now_ns)
    states = recent(5)
    endpoint = Endpoint(udp)
    with serving(link, output):
        greeted(endpoint, link)
        for state in states:
            output.outbox.put(state)
        endpoint.until(lambda: len(endpoint.of("GPS_INPUT")) == len(states))
    autopilot = ArduPilot(position_of(states[0]))
    for m, state in zip(endpoint.of("GPS_INPUT"), states, strict=True):
        accepted = autopilot.accept(m)
        want = state_of(state)
        assert m.gps_id == 1 and accepted is not None and accepted.quaternion is not None
        assert (accepted.latitude_deg, accepted.longitude_deg) == pytest.approx((want.lat_deg, want.lon_deg), abs=1e-7)
        assert accepted.height_m == pytest.approx(want.height_m - 47.5, abs=1e-4)
        assert accepted.velocity_n == pytest.approx(want.velocity_ned_mps, abs=1e-5)
        yaw = math.degrees(euler(matrix(np.array(accepted.quaternion)))[2])
        assert math.remainder(yaw - want.yaw_deg, 360) == pytest.approx(0, abs=0.01)
        assert accepted.errors[:2] == pytest.approx(
            (max(want.sigma_position_ned_m[:2]), want.sigma_position_ned_m[2]), rel=1e-5
        )
        gps_epoch_to_unix_us = (315_964_800 - 18) * 10**6
        assert accepted.time_us + gps_epoch_to_unix_us == pytest.approx(state.t_ns / 1000, abs=1000)


# --- Numbers


# --- What is never sent

LIMITS = "position_sigma_m = 2.0\nvelocity_sigma_mps = 0.5\nyaw_sigma_deg = 5.0\nage_ms = 100.0\n"
UNFIT: list[tuple[dict[str, Any], str]] = [
    ({"mode": Mode.ALIGNING}, "aligning"),
    ({"mode": Mode.LOST}, "lost"),
    ({"age_ns": None}, "older than 100 ms"),
    ({"age_ns": 150 * MS}, "older than 100 ms"),
    ({"scale": 5.0}, "sigma"),
    ({"scale": math.inf}, "covariance"),
]


@pytest.mark.parametrize(("changes", "reason"), UNFIT)
def test_an_unfit_state_is_not_sent_and_that_is_reported_once(
    udp: UdpPeer, tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    settings, link = link_to(udp, tmp_path, ON + LIMITS)
    output = AutopilotOutput(settings, link, CLOCK.now_ns)
    endpoint = Endpoint(udp)
    with np.errstate(invalid="ignore"):
        states = recent(6, **changes)
    with serving(link, output):
        greeted(endpoint, link)
        for state in states:
            output.outbox.put(state)
        endpoint.until(lambda: output.counts()["not fit"] == len(states) and bool(endpoint.texts()))
    assert not endpoint.of("ODOMETRY")
    assert len(endpoint.texts()) == 1
    assert endpoint.texts()[0].startswith("fusiond: not sent to the autopilot: ") and reason in endpoint.texts()[0]
    assert output.notes()["sending"].startswith("no: ") and reason in output.notes()["sending"]


def made(tmp_path: Path, more: str, geoid_m: float = 0.0) -> tuple[AutopilotOutput, Any]:
    settings = configuration(tmp_path, "udpin:127.0.0.1:1", more)
    settings = msgspec.structs.replace(settings, vehicle=msgspec.structs.replace(settings.vehicle, geoid_m=geoid_m))
    link: Any = Recorder(settings)
    return AutopilotOutput(settings, link, lambda: 10**18), link


def test_dead_reckoning_is_sent_only_if_wanted(tmp_path: Path) -> None:
    for wanted in (True, False):
        output, link = made(tmp_path, f"{ON}dead_reckoning = {str(wanted).lower()}\n")
        output.offer(state_at(10**18, mode=Mode.DEAD_RECKONING))
        assert ("ODOMETRY" in link.kinds()) is wanted


def test_a_heading_that_nothing_has_confirmed_is_sent_only_if_wanted(tmp_path: Path) -> None:
    for wanted in (True, False):
        output, link = made(tmp_path, f"{ON}unconfirmed_heading = {str(wanted).lower()}\n")
        output.offer(msgspec.structs.replace(state_at(10**18), heading_confirmed=False))
        assert ("ODOMETRY" in link.kinds()) is wanted
        assert ("drive" in output.notes()["sending"]) is not wanted
        output.offer(state_at(10**18 + 100 * MS))
        assert "ODOMETRY" in link.kinds()


def test_the_origin_is_that_of_the_first_fit_state(tmp_path: Path) -> None:
    output, link = made(tmp_path, ON)
    output.offer(state_at(10**18 - 400 * MS, 0, mode=Mode.LOST))
    assert output.frame.origin is None
    for number in (1, 2, 3):
        output.offer(state_at(10**18 - (4 - number) * 100 * MS, number, resets=number))
    first, *_, last = [m for m in link.sent if m.get_type() == "ODOMETRY"]
    assert (first.x, first.y, first.z) == (0, 0, 0)
    assert last.z == pytest.approx(-6.5) and (last.reset_counter - first.reset_counter) % 256 == 2
    assert output.frame.origin == Origin.of(state_of(state_at(0, 1)))
    assert output.notes()["origin"] == "our own: the autopilot reports none"


def test_a_state_that_waited_too_long_is_not_sent(tmp_path: Path) -> None:
    output, link = made(tmp_path, ON)
    output.offer(state_at(10**18 - 2000 * MS))
    assert not link.sent and output.counts()["stale"] == 1


def test_a_closed_link_is_counted_and_reported(tmp_path: Path) -> None:
    output, link = made(tmp_path, ON)
    link.open = False
    output.offer(state_at(10**18))
    assert output.counts()["link closed or full"] == 1
    assert output.notes()["sending"] == "no: the link is closed or full"


def test_quality_falls_with_the_sigmas(tmp_path: Path) -> None:
    output, link = made(tmp_path, ON)
    for number, scale in enumerate((0.01, 1.0, 2.0)):
        output.offer(state_at(10**18 - (3 - number) * 100 * MS, 0, scale=scale))
    good, fair, poor = (m.quality for m in link.sent if m.get_type() == "ODOMETRY")
    assert 98 <= good <= 100 and good > fair > poor >= 1


def test_the_origin_is_set_until_the_autopilot_names_one(tmp_path: Path) -> None:
    output, link = made(tmp_path, f"{ON}set_origin = true\n")
    sender = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    heartbeat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GROUND_ROVER, 3, 0, 0, 4, 3)
    link.housekeeping.receive(bytes(heartbeat.pack(sender)), 0)
    output.offer(state_at(10**18 - 900 * MS))
    state = state_of(state_at(0))
    set_to = link.sent[1]
    assert set_to.get_type() == "SET_GPS_GLOBAL_ORIGIN" and set_to.target_system == SYSTEM
    assert set_to.latitude == round(state.lat_deg * 1e7) and set_to.altitude == round(state.height_m * 1e3)
    theirs = dialect.MAVLink_gps_global_origin_message(set_to.latitude, set_to.longitude, set_to.altitude, 0)
    output.readback.receive(bytes(theirs.pack(sender)), 0)
    output.offer(state_at(10**18 + 3000 * MS))
    assert link.kinds().count("SET_GPS_GLOBAL_ORIGIN") == 1
    first, second = (m for m in link.sent if m.get_type() == "ODOMETRY")
    assert first.reset_counter == second.reset_counter  # it has taken ours


# --- One local frame, from run to run


def driving(metres: float, t_ms: int) -> StateMessage:
    """A state so far north of the others' start, at an instant after it."""
    message = state_at(10**18 + t_ms * MS)
    state = msgspec.structs.replace(state_of(message), lat_deg=state_of(state_at(0)).lat_deg + metres / 111_200)
    return msgspec.structs.replace(message, state=state)


def run(
    tmp_path: Path, kept: KeptFrame, autopilot: ArduPilot, states: list[StateMessage], *, answers: bool
) -> AutopilotOutput:
    """One run of fusiond, to its end: states to an autopilot that may answer what it is asked."""
    now = [states[0].t_ns]
    link: Any = Recorder(configuration(tmp_path, "udpin:127.0.0.1:1", ON))
    link.housekeeping.target = SYSTEM, COMPONENT
    output = AutopilotOutput(link_settings(tmp_path), link, lambda: now[0], kept)
    sender = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    for state in states:
        now[0] = state.t_ns
        output.ask_for_origin()
        output.offer(state)
        for message in link.sent:
            if message.get_type() == "ODOMETRY":
                autopilot.accept(message)
            elif answers and (answer := autopilot.answer(message)):
                output.readback.receive(bytes(answer.pack(sender)), now[0])
        link.sent.clear()
    return output


def link_settings(tmp_path: Path) -> Config:
    return configuration(tmp_path, "udpin:127.0.0.1:1", ON)


def off_m(autopilot: ArduPilot, state: StateMessage) -> float:
    """Distance of the autopilot's position from a state's."""
    assert autopilot.position is not None
    want = state_of(state)
    north, east = (autopilot.position[0] - want.lat_deg) * 111_200, (autopilot.position[1] - want.lon_deg) * 74_000
    return math.hypot(north, east, autopilot.position[2] - want.height_m)


@pytest.mark.parametrize("answers", [True, False], ids=["reports its origin", "silent"])
@pytest.mark.parametrize("file", [True, False], ids=["state file", "no state file"])
def test_a_restart_in_motion(tmp_path: Path, answers: bool, file: bool) -> None:
    """The autopilot flies on while fusiond is killed and comes back 80 m further: its position is right then, or it is told
    of a jump."""
    begin = state_of(state_at(0))
    autopilot = ArduPilot((begin.lat_deg, begin.lon_deg, begin.height_m))
    kept = KeptFrame()
    before = [driving(10.0 * k / 25, 40 * k) for k in range(25)]
    run(tmp_path, kept, autopilot, before, answers=answers)
    assert off_m(autopilot, before[-1]) < 0.1 and autopilot.told == 0
    after = [driving(80.0 + 10.0 * k / 25, 8000 + 40 * k) for k in range(25)]
    output = run(tmp_path, kept if file else KeptFrame(), autopilot, after, answers=answers)
    assert autopilot.told >= 1
    if answers or file:
        assert off_m(autopilot, after[-1]) < 0.1
    assert output.notes()["origin"].startswith("the autopilot's" if answers else "our own")


def test_many_restarts_are_each_told(tmp_path: Path) -> None:
    """Each run's counter differs from the one before, whatever was counted after the last was kept."""
    autopilot = ArduPilot(position_of(state_at(0)))
    kept, lost = KeptFrame(), 5
    for restart in range(20):
        stale = KeptFrame(kept.origin, kept.reset_counter)
        states = [state_at(10**18 + restart * 10**9 + 40 * k * MS, 0, resets=k) for k in range(lost)]
        run(tmp_path, kept, autopilot, states, answers=True)
        assert autopilot.told == restart * lost + lost - 1
        kept = stale if restart % 2 and stale.reset_counter is not None else kept


def test_an_origin_that_comes_late_is_a_jump_that_is_told(tmp_path: Path) -> None:
    """It gets its own after we began with ours: from then on ours is the same."""
    begin = state_of(state_at(0))
    autopilot = ArduPilot((begin.lat_deg - 0.001, begin.lon_deg, begin.height_m - 20.0))
    kept = KeptFrame()
    output = run(tmp_path, kept, autopilot, [driving(0.0, 0)], answers=False)
    assert off_m(autopilot, driving(0.0, 0)) > 100.0
    sender = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    answer = autopilot.answer(dialect.MAVLink_command_long_message(SYSTEM, 1, 512, 0, 49, 0, 0, 0, 0, 0, 0))
    output.readback.receive(bytes(answer.pack(sender)), 0)
    for k in range(1, 4):
        output.offer(driving(0.5 * k, 40 * k))
        autopilot.accept(output._link.sent[-1])
        assert off_m(autopilot, driving(0.5 * k, 40 * k)) < 0.1
    assert autopilot.told == 1
    assert kept.origin == pytest.approx((begin.lat_deg - 0.001, begin.lon_deg, begin.height_m - 20.0), abs=1e-2)


def test_the_height_of_their_origin_is_above_the_sea(tmp_path: Path) -> None:
    """Ours are above the ellipsoid where the receiver gives that: the geoid's height is what it says, or as configured."""
    sender = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    fix = dialect.MAVLink_gps_raw_int_message(0, 3, 0, 0, 565_000, 80, 120, 0, 0, 14, 612_500)
    for geoid_m, undulation in ((0.0, 47.5), (46.0, 46.0)):
        output, link = made(tmp_path, ON, geoid_m)
        link.housekeeping.target = SYSTEM, COMPONENT
        output.readback.receive(bytes(fix.pack(sender)), 0)
        state = state_of(state_at(0))
        theirs = dialect.MAVLink_gps_global_origin_message(round(state.lat_deg * 1e7), round(state.lon_deg * 1e7), 550_000)
        output.readback.receive(bytes(theirs.pack(sender)), 0)
        output.offer(state_at(10**18))
        assert link.sent[-1].z == pytest.approx(-(612.5 - undulation - 550.0), abs=1e-3)


def test_the_origin_is_asked_for_until_it_comes_and_then_rarely(tmp_path: Path) -> None:
    now = [0]
    link: Any = Recorder(link_settings(tmp_path))
    output = AutopilotOutput(link_settings(tmp_path), link, lambda: now[0])
    output.ask_for_origin()
    assert not link.sent  # whom?
    link.housekeeping.target = SYSTEM, COMPONENT
    for _ in range(100):
        output.ask_for_origin()
        now[0] += 200 * MS
    assert len(link.sent) == 10 and {(m.command, m.param1, m.target_system) for m in link.sent} == {(512, 49, SYSTEM)}
    output.readback.origin = Origin(0.0, 0.0, 0.0)
    for _ in range(100):
        output.ask_for_origin()
        now[0] += 200 * MS
    assert len(link.sent) == 12


def test_faster_than_50_hz_ekf3_drops_half() -> None:
    autopilot = ArduPilot(position_of(state_at(0)))
    for hz, lost in ((40, 0), (50, 0), (100, 50)):
        states = [state_at(10**18 + hz * 10**10 + k * 1000 // hz * MS) for k in range(100)]
        before = autopilot.dropped
        for state in states:
            autopilot.accept(odometry(state, state_of(state), Origin.of(state_of(state)), CONVENTIONS["ardupilot"], 50, 0))
        assert autopilot.dropped - before == lost


# --- Does it use us?

GOOD = 0x33F  # attitude, velocities, positions relative and absolute, predicted too


def report(flags: int, ratio: float) -> Any:
    return dialect.MAVLink_ekf_status_report_message(flags, 0.1, ratio, 0.2, 0.0, 0.0, 0.0)


def px4_status(flags: int, ratio: float) -> Any:
    return dialect.MAVLink_estimator_status_message(1, flags, 0.1, ratio, 0.2, math.nan, math.nan, math.nan, 1.0, 1.0)


def text(what: str) -> Any:
    return dialect.MAVLink_statustext_message(6, what.encode(), 0, 0)


VERDICTS: list[tuple[str, list[Any], str]] = [
    ("ardupilot", [], "unknown"),
    ("ardupilot", [report(GOOD, 0.3)], "likely: it has a position, worst test ratio 0.30"),
    ("ardupilot", [report(GOOD, 0.3), text("EKF3 IMU0 is using external nav data")], "yes"),
    ("ardupilot", [text("EKF3 IMU0 is using external nav data"), report(GOOD, 1.4)], "no: it rejects"),
    ("ardupilot", [report(GOOD, 0.3), text("EKF3 IMU0 stopped aiding")], "no: it reported that it stopped aiding"),
    ("ardupilot", [report(GOOD | 1024, 0.3)], "no: its estimator is not initialised"),
    ("ardupilot", [report(0x87, 0.3)], "no: it assumes a constant position"),
    ("ardupilot", [report(0x27, 0.3)], "no: it has no horizontal position"),
    ("ardupilot", [dialect.MAVLink_heartbeat_message(10, 12, 0, 0, 4, 3)], "no: the autopilot says it is px4"),
    ("px4", [px4_status(GOOD, 0.3)], "likely"),
    ("px4", [px4_status(GOOD | 1024, 0.3)], "likely"),  # a GPS glitch is no matter of ours
    ("px4", [px4_status(GOOD, 2.5)], "no: it rejects measurements, worst test ratio 2.50"),
]


@pytest.mark.parametrize(("kind", "messages", "verdict"), VERDICTS)
def test_whether_the_autopilot_uses_us(tmp_path: Path, kind: str, messages: list[Any], verdict: str) -> None:
    link: Any = Recorder(configuration(tmp_path, "udpin:127.0.0.1:1", ON))
    link.housekeeping.target = (SYSTEM, COMPONENT)
    readback = Readback(link, kind)
    sender = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    other = dialect.MAVLink(None, srcSystem=SYSTEM + 1, srcComponent=COMPONENT)
    readback.receive(bytes(report(0, 9.0).pack(other)), 0)  # another vehicle's is not ours
    for message in messages:
        readback.receive(bytes(message.pack(sender)), 0)
    assert readback.verdict(1000 * MS).startswith(verdict)
    if verdict.startswith(("likely", "yes")):
        assert readback.verdict(6000 * MS).startswith("unknown")


def test_the_autopilot_is_asked_for_its_status_and_it_is_read_back(udp: UdpPeer, tmp_path: Path) -> None:
    """On a link of the dialect `common`, to which EKF_STATUS_REPORT is unknown."""
    settings, link = link_to(udp, tmp_path, ON)
    output = AutopilotOutput(settings, link, CLOCK.now_ns)
    endpoint = Endpoint(udp)
    with serving(link, output):
        greeted(endpoint, link)
        endpoint.until(lambda: any(m.param1 == 193 for m in endpoint.of("COMMAND_LONG") if m.command == 511))
        endpoint.send(report(GOOD, 0.25))
        endpoint.send(text("EKF3 IMU0 is using external nav data"))
        endpoint.heartbeat()
        endpoint.until(lambda: output.notes()["used"].startswith("yes"))
    assert not link.listeners


# --- A peer that does not read


def test_a_stalled_peer_delays_nothing_else_and_tears_no_frame(tmp_path: Path) -> None:
    stalled = TcpPeer(buffer=4096)
    _, link = link_to(stalled, tmp_path, ON)
    endpoint = Endpoint(stalled)
    message = odometry(state_at(0), state_of(state_at(0)), Origin.of(state_of(state_at(0))), CONVENTIONS["ardupilot"], 50, 0)
    with serving(link):
        greeted(endpoint, link)
        slowest, lost, tries = 0.0, 0, 0
        while lost < 1000 and tries < 100_000:
            began = time.monotonic()
            lost += not link.send(message)
            slowest = max(slowest, time.monotonic() - began)
            tries += 1
        assert lost == 1000
        assert slowest < 0.2
        endpoint.until(lambda: len(endpoint.of("ODOMETRY")) > 0)
        link.send(message)  # the rest of the one that was half taken, then this one
        endpoint.until(lambda: len(endpoint.of("ODOMETRY")) == tries - lost + 1 or link.send(message))
    assert not endpoint.of("BAD_DATA")
    stalled.close()


# --- Configuration
