"""Inertial and GNSS samples out of CAN frames: which messages belong together, units, axes, and what is unusable."""

from __future__ import annotations

import math
from pathlib import Path
from threading import Event, Thread
from time import sleep

import can
import cantools
import pytest

from fusiond.config import load as config
from fusiond.config.toml import ConfigError
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Invalid, Received
from fusiond.ports.inputs import Inbox
from fusiond.units import MILLISECOND, SECOND
from fusiond_adapters.can.bus import CanBus
from fusiond_adapters.can.decoder import CanDecoder
from fusiond_adapters.host.clock import HostClock

DBC = """VERSION ""
BU_: ECU
BO_ 16 ACCEL: 6 ECU
 SG_ X : 0|16@1- (0.01,0) [0|0] "m/s^2" Vector__XXX
 SG_ Y : 16|16@1- (0.01,0) [0|0] "m/s^2" Vector__XXX
 SG_ Z : 32|16@1- (0.01,0) [0|0] "m/s^2" Vector__XXX
BO_ 17 GYRO: 8 ECU
 SG_ X : 0|16@1- (0.1,0) [0|0] "deg/s" Vector__XXX
 SG_ Y : 16|16@1- (0.1,0) [0|0] "deg/s" Vector__XXX
 SG_ Z : 32|16@1- (0.1,0) [0|0] "deg/s" Vector__XXX
 SG_ GOOD : 48|1@1+ (1,0) [0|1] "" Vector__XXX
BO_ 32 PLACE: 8 ECU
 SG_ LAT : 0|32@1- (1E-007,0) [0|0] "deg" Vector__XXX
 SG_ LON : 32|32@1- (1E-007,0) [0|0] "deg" Vector__XXX
BO_ 33 HEIGHT: 4 ECU
 SG_ HEIGHT : 0|16@1- (0.1,0) [0|0] "m" Vector__XXX
 SG_ SIGMA : 16|8@1+ (0.1,0) [0|0] "m" Vector__XXX
 SG_ VALID : 24|1@1+ (1,0) [0|1] "" Vector__XXX
BO_ 34 MOTION: 8 ECU
 SG_ SPEED : 0|16@1+ (0.01,0) [0|0] "km/h" Vector__XXX
 SG_ COURSE : 16|16@1+ (0.01,0) [0|360] "deg" Vector__XXX
 SG_ NORTH : 32|16@1- (0.01,0) [0|0] "m/s" Vector__XXX
 SG_ EAST : 48|16@1- (0.01,0) [0|0] "m/s" Vector__XXX
BO_ 35 TIME: 5 ECU
 SG_ EPOCH : 0|40@1+ (0.001,1577840400) [0|0] "s" Vector__XXX
BO_ 36 STATUS: 1 ECU
 SG_ FIX : 0|8@1+ (1,0) [0|0] "" Vector__XXX
"""
DATABASE = cantools.database.load_string(DBC, "dbc")
IMU = """[imu.imu0]
bus = "body"
accel_signals = ["ACCEL.X", "ACCEL.Y", "ACCEL.Z"]
gyro_signals = ["GYRO.X", "GYRO.Y", "GYRO.Z"]
gyro_unit = "deg/s"
"""
GNSS = """[gnss.gps0]
bus = "body"
latitude_signal = "PLACE.LAT"
longitude_signal = "PLACE.LON"
height_signal = "HEIGHT.HEIGHT"
"""
COURSE = 'speed_signal = "MOTION.SPEED"\ncourse_signal = "MOTION.COURSE"\nspeed_unit = "km/h"\n'


class Bus:
    """A bus with one sensor or more; each message is received a millisecond after the one before."""

    def __init__(self, folder: Path, *sensors: str) -> None:
        (folder / "body.dbc").write_text(DBC)
        imu = () if IMU in sensors or any("[imu" in sensor for sensor in sensors) else (IMU,)
        text = "".join(['[can.body]\ndbc = ["body.dbc"]\n', *imu, *sensors])
        self.decoder = CanDecoder(config.parse(text, folder / "c.toml"), "body")
        self.now_ns = SECOND

    def send(self, message: str, cut: int | None = None, **values: float) -> list[Received]:
        self.now_ns += MILLISECOND
        kind = DATABASE.get_message_by_name(message)
        data = kind.encode({signal.name: 0.0 for signal in kind.signals} | values, strict=False)
        return self.decoder.decode(kind.frame_id, False, data[:cut], self.now_ns)

    def place(self, **values: float) -> list[Received]:
        found = self.send("PLACE", LAT=48.0, LON=11.0)
        return found + self.send("HEIGHT", **{"HEIGHT": 500.0, "VALID": 1.0} | values)


def payloads(events: list[Received]) -> list[object]:
    return [event.payload for event in events]


def test_a_sample_of_two_messages_comes_with_the_second(tmp_path: Path) -> None:
    bus = Bus(tmp_path, IMU)
    assert bus.send("ACCEL", X=1.0, Y=2.0, Z=-9.8) == []
    (event,) = bus.send("GYRO", X=90.0, Z=-45.0)
    assert (event.source, event.sequence, event.clock, event.t_sensor_ns) == ("imu0", 0, "", None)
    assert event.t_receive_ns == bus.now_ns
    assert isinstance(event.payload, ImuSample)
    assert event.payload.specific_force_b == pytest.approx((1.0, 2.0, -9.8))
    assert event.payload.angular_rate_b == pytest.approx((math.pi / 2, 0.0, -math.pi / 4))


def test_a_message_that_is_missing_makes_one_sample_incomplete(tmp_path: Path) -> None:
    bus = Bus(tmp_path, IMU)
    bus.send("ACCEL", X=1.0)
    assert payloads(bus.send("ACCEL", X=2.0)) == [Invalid("incomplete")]
    (event,) = bus.send("GYRO")
    assert isinstance(event.payload, ImuSample)
    assert event.payload.specific_force_b[0] == 2.0


def test_messages_of_different_samples_are_not_put_together(tmp_path: Path) -> None:
    bus = Bus(tmp_path, IMU)
    bus.send("ACCEL", X=1.0)
    bus.now_ns += 5 * MILLISECOND  # half of the interval, and the millisecond of sending
    assert payloads(bus.send("GYRO")) == [Invalid("incomplete")]
    assert payloads(bus.send("ACCEL", X=3.0))[0] == ImuSample((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_axes_are_turned_and_units_are_converted(tmp_path: Path) -> None:
    bus = Bus(tmp_path, IMU.replace("deg/s", "rad/s") + 'accel_unit = "g"\nrotation_deg = [0, 0, 90]\n')
    bus.send("ACCEL", X=1.0)
    (event,) = bus.send("GYRO", Y=1.0)
    assert isinstance(event.payload, ImuSample)
    assert event.payload.specific_force_b == pytest.approx((0.0, 9.80665, 0.0))
    assert event.payload.angular_rate_b == pytest.approx((-1.0, 0.0, 0.0))


def test_an_inertial_sample_that_is_not_valid(tmp_path: Path) -> None:
    bus = Bus(tmp_path, IMU + 'valid_signals = ["GYRO.GOOD"]\naccel_limit = 50\n')
    bus.send("ACCEL")
    assert payloads(bus.send("GYRO")) == [Invalid("valid_signals")]
    bus.send("ACCEL", X=60.0)
    assert payloads(bus.send("GYRO", GOOD=1)) == [Invalid("beyond accel_limit")]
    assert payloads(bus.send("ACCEL", cut=4)) == [Invalid("short frame")]


def test_a_fix_of_two_messages(tmp_path: Path) -> None:
    bus = Bus(tmp_path, GNSS, 'position_sigma_signal = "HEIGHT.SIGMA"\n')
    (event,) = bus.place(SIGMA=2.5)
    assert (event.source, event.clock, event.t_sensor_ns) == ("gps0.position", "", None)
    assert event.payload == GnssPosition(math.radians(48.0), math.radians(11.0), 500.0, 2.5, None, 3)
    (event,) = bus.place(SIGMA=0.0)
    assert isinstance(event.payload, GnssPosition)
    assert event.payload.sigma_horizontal is None  # 0 is not an accuracy


def test_a_fix_with_its_own_time(tmp_path: Path) -> None:
    bus = Bus(tmp_path, GNSS, 'time_signal = "TIME.EPOCH"\n')
    assert bus.place() == []
    (event,) = bus.send("TIME", EPOCH=1_600_000_000.125)
    assert (event.clock, event.t_sensor_ns) == ("body/gps0", 1_600_000_000_125_000_000)
    arrival = Bus(tmp_path, GNSS, 'time_signal = "TIME.EPOCH"\nstamp = "arrival"\n')
    (event,) = arrival.place()
    assert (event.clock, event.t_sensor_ns) == ("", None)


def test_velocity_by_speed_and_course_or_north_and_east(tmp_path: Path) -> None:
    (event,) = Bus(tmp_path, GNSS, COURSE).send("MOTION", SPEED=36.0, COURSE=90.0)
    assert event.source == "gps0.velocity"
    assert isinstance(event.payload, GnssVelocity)
    assert (event.payload.north, event.payload.east) == pytest.approx((0.0, 10.0), abs=1e-9)
    north = 'north_signal = "MOTION.NORTH"\neast_signal = "MOTION.EAST"\n'
    (event,) = Bus(tmp_path, GNSS, north).send("MOTION", NORTH=-3.0, EAST=4.0)
    assert event.payload == GnssVelocity(-3.0, 4.0, None, None)
    assert Bus(tmp_path, GNSS).send("MOTION", SPEED=36.0) == []


def test_the_kind_of_fix_is_the_latest_received(tmp_path: Path) -> None:
    bus = Bus(tmp_path, GNSS, COURSE, 'fix_type_signal = "STATUS.FIX"\nfix_types = [0, 0, 2, 3, 5]\n')
    assert payloads(bus.place()) == payloads(bus.send("MOTION")) == [Invalid("no fix")]
    for value, fix_type in ((3, 3), (4, 5)):
        bus.send("STATUS", FIX=value)
        (payload,) = payloads(bus.place())
        assert isinstance(payload, GnssPosition)
        assert payload.fix_type == fix_type
    for value in (2, 9):  # 2-D; a value that has no meaning
        bus.send("STATUS", FIX=value)
        assert payloads(bus.place()) == [Invalid("no fix")]


def test_a_valid_signal_guards_what_comes_with_it(tmp_path: Path) -> None:
    bus = Bus(tmp_path, GNSS, COURSE, 'valid_signals = ["HEIGHT.VALID"]\n')
    assert payloads(bus.place(VALID=0)) == [Invalid("valid_signals")]
    assert isinstance(payloads(bus.send("MOTION", SPEED=36.0))[0], GnssVelocity)
    assert isinstance(payloads(bus.place(VALID=1))[0], GnssPosition)


def test_a_valid_signal_of_its_own_message_guards_all(tmp_path: Path) -> None:
    bus = Bus(tmp_path, GNSS, COURSE, 'valid_signals = ["STATUS.FIX"]\n')
    assert payloads(bus.place()) == payloads(bus.send("MOTION")) == [Invalid("valid_signals")]
    bus.send("STATUS", FIX=1)
    assert not {Invalid("valid_signals")} & {*payloads(bus.place()), *payloads(bus.send("MOTION"))}


@pytest.mark.parametrize(
    ("sensor", "complaint"),
    [
        (IMU.replace("ACCEL.X", "ACEL.X"), "imu.imu0: ACEL.X: there is no message 'ACEL' in the DBC; there is: ACCEL"),
        (IMU.replace("GYRO.Z", "GYRO.W"), "imu.imu0: GYRO.W: there is no signal of GYRO 'W' in the DBC; there is: "),
    ],
)
def test_what_the_dbc_lacks_is_named(tmp_path: Path, sensor: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as raised:
        Bus(tmp_path, sensor)
    assert complaint in str(raised.value)


def test_samples_come_live_from_a_bus(tmp_path: Path) -> None:
    """A session on python-can's virtual bus: what another sends is decoded as from a log."""
    (tmp_path / "body.dbc").write_text(DBC)
    text = f'[can.body]\ndbc = ["body.dbc"]\ninterface = "virtual"\nchannel = "samples"\n{IMU}{GNSS}'
    live = CanBus(config.parse(text, tmp_path / "c.toml"), "body", Inbox(64, lambda: None, hash), HostClock())
    live.prepare()
    stop = Event()
    with can.Bus(interface="virtual", channel="samples") as sender:
        thread = Thread(target=live.session, args=(stop,))
        thread.start()
        try:
            found: list[Received] = []
            for _ in range(200):
                for name, values in (("ACCEL", {"Z": -9.75}), ("GYRO", {}), ("PLACE", {"LAT": 48.0}), ("HEIGHT", {})):
                    kind = DATABASE.get_message_by_name(name)
                    data = kind.encode({signal.name: 0.0 for signal in kind.signals} | values, strict=False)
                    sender.send(can.Message(arbitration_id=kind.frame_id, is_extended_id=False, data=data))
                sleep(0.01)
                found += [event for t_ns, frame in live.inbox.take() for event in live.decode(frame, t_ns)]
                if {"imu0", "gps0.position"} <= {event.source for event in found}:
                    break
        finally:
            stop.set()
            thread.join()
    samples = [event.payload for event in found if isinstance(event.payload, ImuSample)]
    assert samples and samples[0].specific_force_b == pytest.approx((0.0, 0.0, -9.75))
    assert any(isinstance(event.payload, GnssPosition) for event in found)
