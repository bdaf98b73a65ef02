"""MAVLink frames in, events out: every message, every stamp kind, every value that means "unknown"."""

from __future__ import annotations

import math
from typing import Any

import pymavlink.dialects.v20.ardupilotmega as dialect
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond.events import ClockPair, GnssPosition, GnssVelocity, ImuSample, Invalid, Received
from fusiond_adapters.mavlink.decoder import (
    Dialect,
    FrameSplitter,
    MavlinkDecoder,
    PeerSplitter,
    frame_length,
    message_id,
)

UNIX_US = 1_700_000_000_000_000
T_NS = 1_700_000_000_250_000_000


def configured(link: str = "", imu: str = "", gnss: str = "") -> Config:
    head = f'[mavlink.fc]\ndialect = "ardupilotmega"\n{link}\n'
    return config.parse(f'{head}[imu.imu0]\nlink = "fc"\n{imu}\n[gnss.gps0]\nlink = "fc"\n{gnss}')


def decoder(link: str = "system = 1", imu: str = "", gnss: str = "") -> MavlinkDecoder:
    return MavlinkDecoder(configured(link, imu, gnss), "fc")


class Sender:
    """Packs messages as an autopilot would send them."""

    def __init__(self, system: int = 1, component: int = 1, version: int = 2, signed: bool = False) -> None:
        self._mav = dialect.MAVLink(None, system, component)
        self._old = version == 1
        if signed:
            self._mav.signing.secret_key = bytes(32)
            self._mav.signing.sign_outgoing = True

    def pack(self, message: Any) -> bytes:
        frame = bytes(message.pack(self._mav, force_mavlink1=self._old))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def highres(self, **fields: Any) -> bytes:
        zeros = dict.fromkeys(dialect.MAVLink_highres_imu_message.fieldnames, 0)
        sample = {"xacc": 0.5, "time_usec": 5000000, "fields_updated": 63, "yacc": 0.25, "zacc": -9.75, "xgyro": 0.125}
        return self.pack(dialect.MAVLink_highres_imu_message(**zeros | sample | fields))

    def gps(self, kind: str = "gps_raw_int", **fields: Any) -> bytes:
        message = getattr(dialect, f"MAVLink_{kind}_message")
        zeros = dict.fromkeys(message.fieldnames, 0)
        fix = {
            "time_usec": UNIX_US, "fix_type": 3, "lat": 481234567, "lon": -1225000000, "alt": 98765,
            "vel": 1000, "cog": 9000, "eph": 90, "epv": 120,
        }  # fmt: skip
        return self.pack(message(**zeros | fix | fields))

    def heartbeat(self, vehicle: int = 10, autopilot: int = 3) -> bytes:
        return self.pack(dialect.MAVLink_heartbeat_message(vehicle, autopilot, 0, 0, 0, 3))


def one(events: list[Received]) -> Received:
    assert len(events) == 1
    return events[0]


@pytest.mark.parametrize("sender", [Sender(), Sender(version=1), Sender(signed=True)], ids=["v2", "v1", "signed"])
def test_every_protocol_version_is_read(sender: Sender) -> None:
    frame = sender.highres()
    assert frame_length(frame) == len(frame)
    assert message_id(frame) == dialect.MAVLINK_MSG_ID_HIGHRES_IMU
    event = one(decoder().decode(frame, T_NS))
    sample = ImuSample((0.5, 0.25, -9.75), (0.125, 0.0, 0.0))
    assert event == Received("imu0", 0, "fc/1/boot", 5_000_000_000, T_NS, sample)


def test_sequence_counts_each_source_and_can_be_shared() -> None:
    sender, sequences = Sender(), dict[str, int]()
    first, second = (MavlinkDecoder(configured("system = 1"), "fc", sequences) for _ in range(2))
    events = [*first.decode(sender.highres(), 1), *first.decode(sender.gps(), 2), *second.decode(sender.highres(), 3)]
    assert [(event.source, event.sequence) for event in events] == [
        ("imu0", 0), ("gps0.position", 0), ("gps0.velocity", 0), ("imu0", 1),
    ]  # fmt: skip


def test_scaled_imu_is_milli_g_milli_radians_and_milliseconds() -> None:
    message = dialect.MAVLink_scaled_imu2_message(70_000, 1000, -500, -1000, 100, -200, 300, 0, 0, 0)
    event = one(decoder(imu='message = "SCALED_IMU2"').decode(Sender().pack(message), T_NS))
    assert event.clock == "fc/1/boot"
    assert event.t_sensor_ns == 70_000_000_000
    assert isinstance(event.payload, ImuSample)
    assert event.payload.specific_force_b == pytest.approx((9.80665, -4.903325, -9.80665))
    assert event.payload.angular_rate_b == pytest.approx((0.1, -0.2, 0.3))


def test_raw_imu_only_where_it_is_configured() -> None:
    frame = Sender().pack(dialect.MAVLink_raw_imu_message(UNIX_US, 0, 0, -1000, 0, 0, 500, 0, 0, 0))
    unasked = decoder()
    assert unasked.decode(frame, T_NS) == []
    assert unasked.counts["skipped"] == 1
    event = one(decoder(imu='message = "RAW_IMU"').decode(frame, T_NS))
    assert (event.clock, event.t_sensor_ns) == ("unix", UNIX_US * 1000)


def test_imu_instance_and_freshness() -> None:
    second = decoder(imu="instance = 1")
    assert second.decode(Sender().highres(id=0), T_NS) == []
    assert second.counts["other instances"] == 1
    assert isinstance(one(second.decode(Sender().highres(id=1), T_NS)).payload, ImuSample)
    stale = one(decoder().decode(Sender().highres(fields_updated=0b000111), T_NS))
    assert stale.payload == Invalid("not updated")


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"xacc": math.nan}, "not finite"),
        ({"zgyro": math.inf}, "not finite"),
        ({"yacc": -200.0}, "beyond accel_limit"),
        ({"ygyro": 36.0}, "beyond gyro_limit"),
    ],
)
def test_impossible_imu_values_are_invalid(fields: dict[str, float], reason: str) -> None:
    assert one(decoder().decode(Sender().highres(**fields), T_NS)).payload == Invalid(reason)


@pytest.mark.parametrize(
    ("angles", "forward"),
    [("[0, 0, 90]", (0, 1, 0)), ("[0, 90, 0]", (0, 0, -1)), ("[90, 0, 90]", (0, 1, 0)), ("[0, 90, 90]", (0, 0, -1))],
)
def test_rotation_takes_the_sensors_x_axis_into_the_body(angles: str, forward: tuple[float, float, float]) -> None:
    frame = Sender().highres(xacc=2.0, yacc=0.0, zacc=0.0)
    payload = one(decoder(imu=f"rotation_deg = {angles}").decode(frame, T_NS)).payload
    assert isinstance(payload, ImuSample)
    assert payload.specific_force_b == pytest.approx([2.0 * axis for axis in forward], abs=1e-12)


@pytest.mark.parametrize("kind", ["gps_raw_int", "gps2_raw"])
def test_fix_in_si_units(kind: str) -> None:
    frame = Sender().gps(kind, alt_ellipsoid=123456, h_acc=1500, v_acc=2500, vel_acc=300)
    position, velocity = decoder(gnss=f'message = "{kind.upper()}"').decode(frame, T_NS)
    assert (position.source, velocity.source) == ("gps0.position", "gps0.velocity")
    assert position.t_sensor_ns == velocity.t_sensor_ns == UNIX_US * 1000
    expected = GnssPosition(math.radians(48.1234567), math.radians(-122.5), 123.456, 1.5, 2.5)
    assert position.payload == expected
    assert isinstance(velocity.payload, GnssVelocity)
    assert (velocity.payload.north, velocity.payload.east) == pytest.approx((0.0, 10.0))
    assert (velocity.payload.down, velocity.payload.sigma) == (None, 0.3)


def test_unknown_accuracy_and_ellipsoidal_height() -> None:
    position, velocity = decoder().decode(Sender().gps(), T_NS)
    assert isinstance(position.payload, GnssPosition)
    assert isinstance(velocity.payload, GnssVelocity)
    assert position.payload.height == 98.765  # mean sea level, where the receiver gives nothing else
    assert (position.payload.sigma_horizontal, position.payload.sigma_vertical) == (None, None)
    assert velocity.payload.sigma is None


@pytest.mark.parametrize(
    ("time_us", "clock", "t_ns"),
    [
        (UNIX_US, "unix", UNIX_US * 1000),
        (123_456_789, "fc/1/boot", 123_456_789_000),
        (0, "", None),
        (2**63, "", None),
    ],
)
def test_stamp_kinds(time_us: int, clock: str, t_ns: int | None) -> None:
    for event in decoder().decode(Sender().gps(time_usec=time_us), T_NS):
        assert (event.clock, event.t_sensor_ns, event.t_receive_ns) == (clock, t_ns, T_NS)


def test_stamp_of_arrival_by_configuration() -> None:
    for event in decoder(gnss='stamp = "arrival"').decode(Sender().gps(), T_NS):
        assert (event.clock, event.t_sensor_ns) == ("", None)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"fix_type": 2}, "no fix"),
        ({"lat": 0, "lon": 0}, "no position"),
        ({"lat": 910_000_000}, "not on earth"),
    ],
)
def test_no_fix_is_invalid(fields: dict[str, int], reason: str) -> None:
    events = decoder().decode(Sender().gps(**fields), T_NS)
    assert [event.payload for event in events] == [Invalid(reason), Invalid(reason)]


def test_a_lower_fix_type_by_configuration() -> None:
    position, _ = decoder(gnss="minimum_fix_type = 2").decode(Sender().gps(fix_type=2), T_NS)
    assert isinstance(position.payload, GnssPosition)


@pytest.mark.parametrize("unknown", [{"vel": 65535}, {"cog": 65535}])
def test_unknown_velocity_gives_no_velocity(unknown: dict[str, int]) -> None:
    assert one(decoder().decode(Sender().gps(**unknown), T_NS)).source == "gps0.position"


def test_velocity_can_be_left_out() -> None:
    assert one(decoder(gnss="use_velocity = false").decode(Sender().gps(), T_NS)).source == "gps0.position"


def test_system_time_pairs_two_clocks() -> None:
    sender, reader = Sender(), decoder()
    event = one(reader.decode(sender.pack(dialect.MAVLink_system_time_message(UNIX_US, 5_000)), T_NS))
    assert (event.source, event.clock, event.t_sensor_ns) == ("fc.time", "unix", UNIX_US * 1000)
    assert event.payload == ClockPair("fc/1/boot", 5_000_000_000)
    for unset in (0, 86_400_000_000, 2**63):
        assert reader.decode(sender.pack(dialect.MAVLink_system_time_message(unset, 5_000)), T_NS) == []


def test_the_first_autopilot_is_followed() -> None:
    reader = decoder("")
    station, gimbal, autopilot = Sender(255, 190), Sender(7, 154), Sender(42)
    for frame in (station.heartbeat(6, 8), station.heartbeat(6, 3), gimbal.heartbeat(26, 8)):
        assert reader.decode(frame, T_NS) == []
    assert reader.system == 0
    reader.decode(autopilot.heartbeat(autopilot=0), T_NS)
    assert (reader.system, reader.found) == (42, True)
    assert one(reader.decode(autopilot.highres(), T_NS)).clock == "fc/42/boot"
    assert reader.decode(gimbal.highres(), T_NS) == []
    reader.decode(Sender(43).heartbeat(), T_NS)
    assert reader.system == 42
    assert reader.counts["other systems"] == 5


def test_a_sender_of_wanted_data_stands_in_until_an_autopilot_is_heard() -> None:
    reader = decoder("")
    early, autopilot = Sender(9), Sender(42)
    assert one(reader.decode(early.highres(), T_NS)).source == "imu0"
    assert reader.decode(autopilot.highres(), T_NS) == []
    reader.decode(autopilot.heartbeat(), T_NS)
    assert one(reader.decode(autopilot.highres(), T_NS)).clock == "fc/42/boot"
    assert reader.decode(early.highres(), T_NS) == []
    reader.decode(early.heartbeat(), T_NS)
    assert reader.system == 42


def test_only_the_configured_component() -> None:
    reader = decoder("component = 2")
    assert reader.decode(Sender(1, 1).heartbeat(), T_NS) == []
    assert reader.system == 0
    assert reader.decode(Sender(1, 1).highres(), T_NS) == []
    assert one(reader.decode(Sender(1, 2).highres(), T_NS)).source == "imu0"
    assert reader.counts["other components"] == 2


def test_counts_of_lost_and_damaged_frames() -> None:
    sender, reader = Sender(), decoder()
    frames = [sender.highres() for _ in range(300)]
    for number, frame in enumerate(frames):
        if number not in (3, 4, 255, 256):
            reader.decode(frame, T_NS)
    reader.decode(frames[-1], T_NS)  # a repeat is no loss
    assert reader.counts["lost"] == 4
    broken = bytearray(sender.highres())
    broken[20] ^= 1
    assert reader.decode(bytes(broken), T_NS) == []
    assert reader.counts["bad checksum"] == 1
    for part in (b"", b"\xfd", frames[0][:-1], b"hello, world"):
        assert reader.decode(part, T_NS) == []
    assert reader.counts["undecodable"] == 4


def numbered(count: int) -> list[bytes]:
    sender = Sender()
    return [sender.highres(time_usec=1_000_000 + 10_000 * number) for number in range(count)]


@pytest.mark.parametrize("gap", [1, 127, 128, 200, 255])
def test_a_gap_of_any_size_is_counted_and_not_again_with_the_next_frame(gap: int) -> None:
    reader, frames = decoder(), numbered(600)
    for frame in frames[:150] + frames[150 + gap :]:
        reader.decode(frame, T_NS)
    assert (reader.counts["lost"], reader.counts["late"]) == (gap, 0)


def test_frames_out_of_order_are_late_and_repeats_are_nothing() -> None:
    reader, frames = decoder(), numbered(20)
    for number in (0, 1, 3, 2, 4, 7, 5, 6, 7, 7, 8, 3, 9):
        reader.decode(frames[number], T_NS)
    assert (reader.counts["lost"], reader.counts["late"]) == (3, 3)
    for frame in frames[10:]:
        reader.decode(frame, T_NS)
    assert reader.counts["lost"] == 3


def test_messages_that_no_checksum_confirms_make_no_loss_and_hide_none() -> None:
    reader, frames = decoder(), numbered(400)
    for number, frame in enumerate(frames):
        unknown = bytearray(frame)
        unknown[7:10] = b"\xff\xff\xff"
        if number % 3 == 0:
            reader.decode(bytes(unknown), T_NS)  # the autopilot's own, which the dialect lacks
        elif number not in (100, 101):
            reader.decode(frame, T_NS)
        unknown[4] = number * 37 & 0xFF  # a stranger's, with a counter of its own
        if number % 7 == 1:
            reader.decode(bytes(unknown), T_NS)
    assert reader.counts["lost"] == 2


@pytest.mark.parametrize(("name", "missing"), [("martian", "known: .*common"), ("minimal", "SYSTEM_TIME|HIGHRES_IMU")])
def test_a_dialect_that_does_not_do(name: str, missing: str) -> None:
    settings_ = config.parse(f'[mavlink.fc]\ndialect = "{name}"\n[imu.imu0]\nlink = "fc"')
    with pytest.raises(ConfigError, match=f"mavlink.fc.dialect.*({missing})"):
        MavlinkDecoder(settings_, "fc")


def frames_of_all_kinds() -> list[bytes]:
    modern, old, signed = Sender(), Sender(version=1), Sender(signed=True)
    unknown = bytearray(modern.highres())
    unknown[7:10] = b"\xff\xff\xff"  # an id that no dialect has
    return [modern.highres(), old.gps(), bytes(unknown), signed.heartbeat(), modern.gps(), old.heartbeat()]


@pytest.mark.parametrize("size", [1, 2, 3, 7, 64, 10_000])
def test_splitter_gives_back_the_frames_whatever_the_pieces(size: int) -> None:
    frames = frames_of_all_kinds()
    stream = b"".join(frames)
    splitter = FrameSplitter(Dialect("ardupilotmega"))
    pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert [frame for piece in pieces for frame in splitter.feed(piece)] == frames
    assert splitter.skipped_bytes == 0


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=40), min_size=4, max_size=4), st.integers(1, 50))
def test_splitter_finds_every_frame_between_garbage(garbage: list[bytes], size: int) -> None:
    frames = [frame for frame in frames_of_all_kinds() if message_id(frame) != 0xFFFFFF][:4]
    parts = [(b"\0" + rubbish, frame) for rubbish, frame in zip(garbage, frames, strict=True)]
    stream = b"".join(part for pair in parts for part in pair) + bytes(300)
    splitter = FrameSplitter(Dialect("ardupilotmega"))
    found = [frame for at in range(0, len(stream), size) for frame in splitter.feed(stream[at : at + size])]
    assert [frame for frame in found if message_id(frame) in dialect.mavlink_map] == frames


def test_splitter_believes_an_unknown_message_only_between_frames() -> None:
    known, unknown = Sender().highres(), frames_of_all_kinds()[2]
    splitter = FrameSplitter(Dialect("ardupilotmega"))
    assert splitter.feed(b"\0" + unknown) == []  # what follows is not known yet
    assert splitter.feed(known) == [unknown, known]
    assert splitter.skipped_bytes == 1


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_flipped_bits_never_raise_and_never_lie(data: st.DataObject) -> None:
    frame = bytearray(Sender(signed=data.draw(st.booleans())).gps(h_acc=900))
    good = decoder().decode(bytes(frame), T_NS)
    for bit in data.draw(st.lists(st.integers(0, 8 * len(frame) - 1), min_size=1, max_size=3, unique=True)):
        frame[bit // 8] ^= 1 << bit % 8
    assert decoder().decode(bytes(frame), T_NS) in ([], good)


def hostile(size: int = 255) -> bytes:
    """The beginning of a frame of an unknown message that claims `size` bytes."""
    return bytes((0xFD, size, 0, 0, 9, 1, 1, 0xFF, 0xFF, 0xFF))


def test_beginnings_of_frames_swallow_no_datagram() -> None:
    """28 of 10 bytes in a second swallowed two thirds of the vehicle's frames."""
    splitter, frames = PeerSplitter(Dialect("ardupilotmega"), datagrams=True), numbered(300)
    found = []
    for frame in frames:
        splitter.feed(hostile(), "stranger")
        splitter.feed(hostile(), "vehicle")  # with a forged address
        found += splitter.feed(frame, "vehicle")
    assert found == frames
    assert splitter.skipped_bytes + splitter.waiting_bytes == 2 * 10 * len(frames)


@pytest.mark.parametrize("size", [1, 20, 100])
def test_frames_that_a_bridge_cuts_into_datagrams_are_put_together(size: int) -> None:
    frames = numbered(20)
    stream = b"".join(frames)
    splitter = PeerSplitter(Dialect("ardupilotmega"), datagrams=True)
    found = []
    for at in range(0, len(stream), size):
        found += splitter.feed(stream[at : at + size], "bridge")
        splitter.feed(hostile(), at)  # of as many strangers
    assert found == frames


def test_incomplete_frames_of_many_peers_are_bounded_and_counted() -> None:
    splitter = PeerSplitter(Dialect("ardupilotmega"), datagrams=True)
    for peer in range(1000):
        splitter.feed(hostile(), peer)
    assert splitter.waiting_bytes == 10 * PeerSplitter.PARTS
    assert splitter.skipped_bytes == 10 * (1000 - PeerSplitter.PARTS)


def test_the_next_peer_of_a_stream_begins_anew() -> None:
    splitter, (frame,) = PeerSplitter(Dialect("ardupilotmega"), datagrams=False), numbered(1)
    assert splitter.feed(hostile(), 1) == []
    assert splitter.feed(frame[:20], 2) == []
    assert splitter.feed(frame[20:], 2) == [frame]
    assert splitter.skipped_bytes == 10


@pytest.mark.parametrize("datagrams", [True, False])
def test_garbage_is_not_searched_at_every_byte(datagrams: bool) -> None:
    """Each byte of 0xFE begins a frame of 262 bytes, whose checksum would be computed."""
    checked = []

    class Counting(Dialect):
        def sound(self, frame: bytes) -> bool | None:
            checked.append(len(frame))
            return super().sound(frame)

    splitter = PeerSplitter(Counting("ardupilotmega"), datagrams=datagrams)
    for _ in range(10):
        splitter.feed(b"\xfe" * 4096, "stranger")
    assert len(checked) <= 10 * 64
    assert splitter.skipped_bytes + splitter.waiting_bytes == 10 * 4096
