"""WHEEL_DISTANCE, SCALED_PRESSURE and the yaw of GPS_RAW_INT to events, and TIMESYNC's answers."""

from __future__ import annotations

import math
from typing import Any

import pymavlink.dialects.v20.ardupilotmega as dialect
import pytest

from fusiond.config import load as config
from fusiond.config.schema import sensor_tables
from fusiond.config.toml import ConfigError
from fusiond.events import (
    HOST_CLOCK,
    ClockPair,
    GnssPosition,
    GnssYaw,
    Invalid,
    Pressure,
    Received,
    WheelSpeed,
)
from fusiond_adapters.mavlink.decoder import TIMESYNC_MARK, MavlinkDecoder
from fusiond_adapters.mavlink.sensors import HANDLERS
from fusiond_adapters.mavlink.timesync import Timesync

BASE = '[mavlink.fc]\nsystem = 1\n[imu.imu0]\nlink = "fc"\n'
YAW = BASE + '[dual_antenna.yaw0]\nlink = "fc"\n'
WHEELS = BASE + '[wheel.left]\nlink = "fc"\nindex = 0\nunsigned = false\n[wheel.right]\nlink = "fc"\nindex = 1\n'
MS = 1_000_000
T0 = 1_700_000_000_000 * MS


class Vehicle:
    """An autopilot's frames, as a decoder takes them; `boot` [ms] is both stamp and receipt unless said otherwise."""

    def __init__(self, text: str) -> None:
        self.decoder = MavlinkDecoder(config.parse(text), "fc")
        self._mav = dialect.MAVLink(None, 1, 1)

    def send(self, message: Any, receive_ms: float, component: int = 1) -> list[Received]:
        self._mav.srcComponent = component
        return self.decoder.decode(bytes(message.pack(self._mav)), T0 + round(receive_ms * MS))

    def wheels(self, boot: float, *distances: float, receive: float | None = None) -> list[Received]:
        values = [*distances, *(0.0,) * (16 - len(distances))]
        message = dialect.MAVLink_wheel_distance_message(round(boot * 1000), len(distances), values)
        return self.send(message, boot if receive is None else receive)


    def fix(self, kind: str = "GPS_RAW_INT", receive: float = 1000, **fields: int) -> list[Received]:
        message = getattr(dialect, f"MAVLink_{kind.lower()}_message")
        values = {"time_usec": 900_000, "fix_type": 3, "lat": 481234567, "lon": 115234567, "yaw": 9000} | fields
        return self.send(message(**dict.fromkeys(message.fieldnames, 0) | values), receive)


def about(speed: float) -> WheelSpeed:
    """A reading without noise of its own, over at most 0.1 s."""
    return WheelSpeed(pytest.approx(speed), pytest.approx(0.0, abs=1e-3))


def payloads(events: list[Received]) -> list[object]:
    return [event.payload for event in events]


def test_speed_is_the_difference_stamped_at_the_middle() -> None:
    vehicle = Vehicle(WHEELS.replace("index = 1", "index = 1\nscale = 1.01\nquantum_m = 0.006"))
    assert vehicle.wheels(1000, 5.0, 7.0) == []
    left, right = vehicle.wheels(1100, 5.5, 7.2)
    assert (left.source, left.clock, left.t_sensor_ns, left.t_receive_ns) == ("left", "fc/1/boot", 1050 * MS, T0 + 1100 * MS)
    assert isinstance(left.payload, WheelSpeed) and isinstance(right.payload, WheelSpeed)
    assert left.payload == about(5.0)
    assert right.payload.speed == pytest.approx(2.02)
    assert right.payload.sigma == pytest.approx(math.sqrt(2 * (0.006 * 1.01) ** 2 / 12) / 0.1, rel=1e-3)
    backwards, _ = vehicle.wheels(1150, 5.4, 7.2)
    assert backwards.payload == about(-2.0)
    assert backwards.t_sensor_ns == 1125 * MS


def test_a_stock_autopilot_sends_a_message_a_second() -> None:
    """Not exactly: some come later than that. The mean of a second says less about its middle."""
    vehicle, boot_ms, distance = Vehicle(WHEELS), 1000.0, 0.0
    vehicle.wheels(boot_ms, distance, distance)
    for k in range(20):
        boot_ms, distance = boot_ms + 1000 + 20 * (-1) ** k, distance + 5.0
        left, _ = vehicle.wheels(boot_ms, distance, distance)
        assert isinstance(left.payload, WheelSpeed)
        assert left.payload.speed == pytest.approx(5.0, rel=0.03)
        assert left.payload.sigma == pytest.approx(2.0 / 24, rel=0.05)


def test_a_standing_wheel_whose_stamp_stands_too() -> None:
    """ArduPilot stamps with the last pulse: the time that passes without one is that of the receipts."""
    vehicle = Vehicle(WHEELS)
    vehicle.wheels(1000, 5.0, 5.0)
    for k in range(1, 30):
        left, _ = vehicle.wheels(1000, 5.0, 5.0, receive=1000 + 100 * k)
        assert left.payload == about(0.0)
        assert left.t_sensor_ns == (1000 + 100 * k - 50) * MS
    left, _ = vehicle.wheels(4000, 5.02, 5.02)
    assert left.payload == about(0.2)


def test_a_copy_of_a_message_is_no_standing_wheel() -> None:
    vehicle = Vehicle(WHEELS)
    vehicle.wheels(1000, 5.0, 5.0)
    assert vehicle.wheels(1000, 5.0, 5.0, receive=1000.5) == []
    assert payloads(vehicle.wheels(1100, 5.5, 5.5)) == [about(5.0)] * 2


@pytest.mark.parametrize(
    ("boot", "left", "right", "reasons"),
    [
        (1100, 0.0, 100.2, ["counter reset", None]),
        (1100, 100.2, 99.9, [None, "counter reset"]),  # the right one counts amounts only
        (1100, 107.0, 107.0, ["counter jumped", "counter jumped"]),
        (3100, 100.2, 100.2, ["gap", "gap"]),
        (500, 0.0, 0.0, ["clock went back", "clock went back"]),
        (1100, math.nan, 100.2, ["not finite", None]),
    ],
)
def test_what_a_counter_must_not_do(boot: float, left: float, right: float, reasons: list[str | None]) -> None:
    vehicle = Vehicle(WHEELS)
    vehicle.wheels(1000, 100.0, 100.0)
    found = [p.reason if isinstance(p, Invalid) else None for p in payloads(vehicle.wheels(boot, left, right))]
    assert found == reasons
    if reasons[0] != "not finite":  # from there on it counts again
        good = payloads(vehicle.wheels(boot + 100, left + 0.5, right + 0.5))
        assert good == [about(5.0)] * 2


def test_a_wheel_that_is_not_in_the_message_and_one_without_a_stamp() -> None:
    vehicle = Vehicle(WHEELS)
    vehicle.wheels(1000, 5.0)
    assert payloads(vehicle.wheels(1100, 5.5)) == [about(5.0), Invalid("no such wheel")]
    assert payloads(vehicle.wheels(0, 6.0, 6.0)) == [Invalid("no stamp")] * 2


@pytest.mark.parametrize("kind", ["", "2", "3"])
def test_pressure_in_pascal_and_kelvin(kind: str) -> None:
    vehicle = Vehicle(BASE + f'[barometer.baro]\nlink = "fc"\nmessage = "SCALED_PRESSURE{kind}"')
    message = getattr(dialect, f"MAVLink_scaled_pressure{kind}_message")
    (event,) = vehicle.send(message(70_000, 1013.25, 0.0, 2500), 70_000)
    assert (event.source, event.clock, event.t_sensor_ns) == ("baro", "fc/1/boot", 70_000 * MS)
    assert event.payload == Pressure(pytest.approx(101_325.0), pytest.approx(298.15))
    reasons = [
        payloads(vehicle.send(message(70_000, *values), 70_000))
        for values in ((0.0, 0.0, 2500), (math.nan, 0.0, 2500), (1013.0, 0.0, 32767))
    ]
    assert reasons == [[Invalid("impossible pressure")], [Invalid("not finite")], [Invalid("impossible temperature")]]


def test_every_kind_of_sensor_that_can_come_by_a_link_has_a_handler() -> None:
    assert set(HANDLERS) == {kind for kind in sensor_tables().values() if "link" in kind.__struct_fields__}


@pytest.mark.parametrize("kind", ["GPS_RAW_INT", "GPS2_RAW"])
def test_the_yaw_of_two_antennas(kind: str) -> None:
    vehicle = Vehicle(YAW + f'message = "{kind}"')
    (event,) = vehicle.fix(kind, yaw=12345, hdg_acc=150_000)
    assert (event.source, event.clock, event.t_sensor_ns) == ("yaw0", "fc/1/boot", 900 * MS)
    assert event.payload == GnssYaw(pytest.approx(math.radians(123.45)), pytest.approx(math.radians(1.5)))
    (event,) = vehicle.fix(kind, yaw=36000)
    assert event.payload == GnssYaw(pytest.approx(2 * math.pi), None)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"yaw": 0}, "no yaw given"),
        ({"yaw": 65535}, "no yaw at present"),
        ({"yaw": 36001}, "impossible yaw"),
        ({"fix_type": 2}, "no fix"),
    ],
)
def test_a_yaw_that_is_none_is_counted(fields: dict[str, int], reason: str) -> None:
    assert payloads(Vehicle(YAW).fix(**fields)) == [Invalid(reason)]


def test_the_fix_and_the_stamp_that_a_yaw_needs_are_configured() -> None:
    vehicle = Vehicle(YAW + 'minimum_fix_type = 6\nstamp = "arrival"')
    assert payloads(vehicle.fix(fix_type=5)) == [Invalid("no fix")]
    (event,) = vehicle.fix(fix_type=6)
    assert (event.clock, event.t_sensor_ns, event.payload) == ("", None, GnssYaw(math.pi / 2))


def test_position_and_yaw_of_one_message_are_two_sensors() -> None:
    """Each gets its own fields of it, whichever stands first, and each its own delay and bounds."""
    both = BASE + '[dual_antenna.yaw0]\nlink = "fc"\n[gnss.gps0]\nlink = "fc"\nuse_velocity = false\nminimum_fix_type = 5\n'
    vehicle = Vehicle(both)
    position, yaw = vehicle.fix(fix_type=5, h_acc=700, v_acc=900, yaw=18000, hdg_acc=50_000)
    assert (position.source, yaw.source) == ("gps0.position", "yaw0")
    assert position.payload == GnssPosition(math.radians(48.1234567), math.radians(11.5234567), 0.0, 0.7, 0.9, 5)
    assert yaw.payload == GnssYaw(pytest.approx(math.pi), pytest.approx(math.radians(0.5)))
    assert payloads(vehicle.fix(fix_type=4)) == [Invalid("no fix"), GnssYaw(math.pi / 2)]
    assert payloads(vehicle.fix("GPS2_RAW")) == []


def test_answers_to_our_own_timesync_alone() -> None:
    vehicle = Vehicle(BASE)
    asked = (T0 + 5 * MS) // 1000 * 1000 + TIMESYNC_MARK

    def answer(tc1: int, ts1: int, component: int = 1, to: tuple[int, int] = (0, 0)) -> list[Received]:
        return vehicle.send(Timesync(tc1, ts1, *to), 7, component)

    assert answer(9_000_000_000, asked) == []  # whose clock? no autopilot has been heard yet
    vehicle.send(dialect.MAVLink_heartbeat_message(10, 3, 0, 0, 0, 3), 6)
    (event,) = answer(9_000_000_000, asked)
    assert (event.clock, event.t_sensor_ns, event.t_receive_ns) == ("fc/1/boot", 9_000_000_000, T0 + 7 * MS)
    assert event.payload == ClockPair(HOST_CLOCK, asked)
    assert answer(0, asked) == []  # a question
    assert answer(9_000_000_000, asked + 1) == []  # an answer to someone else
    assert answer(9_000_000_000, asked, component=191) == []  # by another companion
    assert len(answer(9_000_000_000, asked, to=(1, 191))) == 1
    assert answer(9_000_000_000, asked, to=(1, 197)) == []  # to another companion that runs fusiond
    assert answer(9_000_000_000, asked, to=(9, 191)) == []


@pytest.mark.parametrize(
    ("wheel", "complaint"),
    [
        ('link = "fc"', "the key 'index' is missing"),
        ('link = "fc"\nindex = 16', "index"),
        ('link = "fd"\nindex = 0', r"there is no \[mavlink.fd\]"),
        ("index = 0", "one of 'bus' .* and 'link' .* is needed"),
        ('link = "fc"\nbus = "can0"\nindex = 0', "and not both"),
        ('link = "fc"\nindex = 0\nsignal = "A"', "signal: has no meaning"),
        ('link = "fc"\nindex = 0\nchecksum = "honda"', "checksum: has no meaning"),
        ('bus = "can0"\nmessage = "M"\nsignal = "S"\nquantum_m = 0.1', "quantum_m: is for wheels that come by link"),
    ],
)
def test_wheels_that_are_half_one_thing(wheel: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        config.parse(BASE + "[can.can0]\n[wheel.w]\n" + wheel)
