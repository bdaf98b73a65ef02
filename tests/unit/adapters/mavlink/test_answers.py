"""Answers to a ground station: commands, requests for messages, parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common

from fusiond_adapters.mavlink.answers import Parameter
from tests.helpers.ground_station import GET, GLOBAL, REQUEST, SET, STATION, STREAMS, from_station, long, station_at
from tests.helpers.mavlink_peers import MS, SYSTEM, UdpListener, serving, state_at


@pytest.fixture
def peer() -> Iterator[UdpListener]:
    made = UdpListener()
    yield made
    made.close()


ACCEPTED, DENIED, UNSUPPORTED = common.MAV_RESULT_ACCEPTED, common.MAV_RESULT_DENIED, common.MAV_RESULT_UNSUPPORTED


def int_(command: int, *values: float) -> Any:
    return common.MAVLink_command_int_message(SYSTEM, 191, 0, command, 0, 0, *values, *[0.0] * (4 - len(values)), 0, 0, 0.0)


@pytest.mark.parametrize(
    ("message", "result"),
    [
        (long(SET, GLOBAL, 50_000), ACCEPTED),
        (int_(SET, GLOBAL, 50_000), ACCEPTED),
        (long(SET, GLOBAL, -1), ACCEPTED),
        (long(SET, GLOBAL, -7), DENIED),
        (long(SET, GLOBAL, math.nan), DENIED),
        (long(SET, GLOBAL, 3e9), DENIED),  # MESSAGE_INTERVAL could not say it
        (long(SET, GLOBAL, math.inf), DENIED),
        (long(SET, 33, 50_000), UNSUPPORTED),
        (long(SET, math.nan, 50_000), UNSUPPORTED),
        (long(GET, GLOBAL), ACCEPTED),
        (long(REQUEST, GLOBAL), ACCEPTED),
        (long(REQUEST, 148), ACCEPTED),
        (long(SET, GLOBAL, 0, component=0), ACCEPTED),
        (long(common.MAV_CMD_NAV_LAND), UNSUPPORTED),
        (int_(common.MAV_CMD_DO_SET_HOME), UNSUPPORTED),
        (long(common.MAV_CMD_NAV_LAND, component=0), None),  # the autopilot's to answer
        (long(SET, 33, 50_000, component=0), None),
        (long(SET, GLOBAL, 50_000, component=1), None),
        (long(SET, GLOBAL, 50_000, system=9), None),
    ],
)
def test_commands_are_answered(peer: UdpListener, tmp_path: Path, message: Any, result: int | None) -> None:
    station, now = station_at(peer.connection, tmp_path)
    endpoint = from_station(peer)
    with serving(station):
        station.outbox.put(state_at(now()))
        endpoint.until(lambda: bool(endpoint.of("HEARTBEAT")))
        endpoint.send(message)
        endpoint.send(common.MAVLink_param_request_read_message(SYSTEM, 191, b"FUS_RATE_HZ", -1))
        endpoint.until(lambda: bool(endpoint.of("PARAM_VALUE")))  # what came before it has been dealt with
    answers = [(m.command, m.result, m.target_system, m.target_component) for m in endpoint.of("COMMAND_ACK")]
    assert answers == ([] if result is None else [(message.command, result, STATION, 190)])


def test_commands_change_what_is_sent(peer: UdpListener, tmp_path: Path) -> None:
    station, now = station_at(peer.connection, tmp_path)
    endpoint = from_station(peer)
    stamps = iter(range(now() - 4000 * MS, now(), 40 * MS))

    def offered(count: int) -> int:
        """The number of states sent, of some number put into the outbox."""
        places, attitudes = (len(endpoint.of(name)) for name in (STREAMS[0], STREAMS[2]))
        for _ in range(count):
            station.outbox.put(state_at(next(stamps)))
        endpoint.until(lambda: len(endpoint.of(STREAMS[2])) == attitudes + count)
        return len(endpoint.of(STREAMS[0])) - places

    def interval_us() -> int:
        known = len(endpoint.of("MESSAGE_INTERVAL"))
        endpoint.send(long(GET, GLOBAL))
        endpoint.until(lambda: len(endpoint.of("MESSAGE_INTERVAL")) > known)
        return int(endpoint.of("MESSAGE_INTERVAL")[-1].interval_us)

    with serving(station):
        assert offered(5) == 5
        assert interval_us() == 40_000
        endpoint.send(long(SET, GLOBAL, 80_000))
        assert interval_us() == 80_000
        assert offered(6) == 3
        endpoint.send(long(SET, GLOBAL, -1))
        assert interval_us() == -1
        assert offered(5) == 0
        endpoint.send(long(REQUEST, GLOBAL))
        assert interval_us() == -1
        assert offered(5) == 1
        endpoint.send(long(SET, GLOBAL, 0))
        assert interval_us() == 40_000
        endpoint.send(long(REQUEST, 148))
        endpoint.until(lambda: bool(endpoint.of("AUTOPILOT_VERSION")))


def test_parameters(peer: UdpListener, tmp_path: Path) -> None:
    rate = [30.0]
    shared = Parameter("AP_RATE_HZ", lambda: rate[0], lambda value: rate.__setitem__(0, value), 4.0, 50.0)
    station, now = station_at(peer.connection, tmp_path, parameters=(shared,))
    endpoint = from_station(peer)

    def asked(message: Any, count: int = 1) -> list[tuple[str, float]]:
        before = len(endpoint.of("PARAM_VALUE"))
        endpoint.send(message)
        endpoint.until(lambda: len(endpoint.of("PARAM_VALUE")) >= before + count)
        return [(m.param_id, round(m.param_value, 3)) for m in endpoint.of("PARAM_VALUE")[before:]]

    def put(name: str, value: float) -> list[tuple[str, float]]:
        return asked(common.MAVLink_param_set_message(SYSTEM, 191, name.encode(), value, 9))

    with serving(station):
        station.outbox.put(state_at(now()))
        endpoint.until(lambda: bool(endpoint.of("HEARTBEAT")))
        whole = [("FUS_RATE_HZ", 100.0), ("FUS_HORIZON_S", 1.0), ("GS_RATE_HZ", 25.0), ("AP_RATE_HZ", 30.0)]
        assert asked(common.MAVLink_param_request_list_message(SYSTEM, 0), 4) == whole
        assert {(m.param_count, m.param_type) for m in endpoint.of("PARAM_VALUE")} == {(4, 9)}
        assert [m.param_index for m in endpoint.of("PARAM_VALUE")] == [0, 1, 2, 3]
        assert asked(common.MAVLink_param_request_read_message(SYSTEM, 191, b"", 1)) == whole[1:2]
        assert asked(common.MAVLink_param_request_read_message(SYSTEM, 191, b"AP_RATE_HZ", -1)) == whole[3:]
        assert put("AP_RATE_HZ", 12.5) == [("AP_RATE_HZ", 12.5)] and rate == [12.5]
        assert put("AP_RATE_HZ", 400.0) == [("AP_RATE_HZ", 12.5)]  # out of range
        assert put("AP_RATE_HZ", math.nan) == [("AP_RATE_HZ", 12.5)]
        assert put("FUS_RATE_HZ", 10.0) == [("FUS_RATE_HZ", 100.0)]  # read-only
        assert put("GS_RATE_HZ", 5.0) == [("GS_RATE_HZ", 5.0)]
        endpoint.send(common.MAVLink_param_request_read_message(SYSTEM, 191, b"NONE", -1))
        endpoint.send(common.MAVLink_param_request_read_message(SYSTEM, 191, b"", 99))
        assert asked(common.MAVLink_param_request_read_message(SYSTEM, 191, b"", 2)) == [("GS_RATE_HZ", 5.0)]
    assert station.limiters[GLOBAL].rate_hz == 5.0
