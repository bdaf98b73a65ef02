"""MAVLink signing: frames signed and checked as pymavlink does, and a timestamp that never falls."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from fusiond.config.load import load
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond_adapters.mavlink.housekeeping import SECOND, Housekeeping
from fusiond_adapters.mavlink.signing import EPOCH_NS, MINUTE, TICK_NS, Signing
from tests.helpers.live import SYSTEM, Autopilot, configuration, parsed

KEY = bytes(range(32))
HOUR = 60 * MINUTE


@pytest.fixture
def settings(tmp_path: Path) -> Config:
    return signed(tmp_path)


def signed(folder: Path, more: str = "", key: bytes = KEY) -> Config:
    (folder / "key").write_bytes(key)
    (folder / "key").chmod(0o640)
    text = f'signing_key_file = "key"\nsigning_timestamp_file = "stamp"\n{more}\n[can.car]'
    configuration(folder, "udpin:127.0.0.1:14550")
    file = folder / "live.toml"
    file.write_text(file.read_text().replace("[can.car]", text))
    return load(file)


def peer(key: bytes = KEY, ahead: int = HOUR) -> common.MAVLink:
    made = common.MAVLink(None, srcSystem=SYSTEM, srcComponent=1)
    made.signing.secret_key = key
    made.signing.sign_outgoing = True
    made.signing.timestamp = (time.time_ns() - EPOCH_NS) // TICK_NS + ahead
    return made


def heartbeat(sender: common.MAVLink) -> bytes:
    return bytes(common.MAVLink_heartbeat_message(10, 3, 0, 0, 0, 3).pack(sender))


def test_sent_frames_satisfy_pymavlink(settings: Config) -> None:
    sent = b"".join(Housekeeping(settings, "fc").due(second * SECOND, alive=True)[0] for second in range(3))
    reader = common.MAVLink(None)
    reader.signing.secret_key = KEY
    assert [message.get_type() for message in reader.parse_buffer(sent)] == ["HEARTBEAT"] * 3
    stranger = common.MAVLink(None)
    stranger.signing.secret_key = bytes(32)
    stranger.robust_parsing = True
    assert {message.get_type() for message in stranger.parse_buffer(sent)} == {"BAD_DATA"}


def test_received_frames_must_be_signed_newer_and_whole(settings: Config) -> None:
    signing, sender = Signing(settings, "fc"), peer()
    first, second = heartbeat(sender), heartbeat(sender)
    assert signing.accepts(first)
    assert signing.accepts(second)
    assert not signing.accepts(first)  # played back
    third = bytearray(heartbeat(sender))
    third[12] ^= 1
    assert not signing.accepts(bytes(third))
    assert not signing.accepts(heartbeat(peer(bytes(32))))
    assert not signing.accepts(Autopilot().heartbeat())
    old = peer()
    old.srcComponent, old.signing.timestamp = 2, old.signing.timestamp - 2 * HOUR
    assert not signing.accepts(heartbeat(old))  # a stream that begins an hour ago
    assert signing.counts == {"unsigned": 1, "wrongly signed": 4, "timestamp not kept": 0}


def test_unsigned_frames_where_they_may_come(tmp_path: Path) -> None:
    signing = Signing(signed(tmp_path, "accept_unsigned = true"), "fc")
    assert signing.accepts(Autopilot().heartbeat())
    assert signing.accepts(heartbeat(peer()))
    assert not signing.accepts(heartbeat(peer(bytes(32))))
    assert signing.counts["unsigned"] == 0


def stamps(settings: Config, frames: int) -> list[int]:
    housekeeping = Housekeeping(settings, "fc")
    sent = [housekeeping.due(second * SECOND, alive=True)[0] for second in range(frames)]
    return [int.from_bytes(frame[-12:-6], "little") for frame in sent]


def test_timestamps_ascend_over_restarts_whatever_the_clock(settings: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    found = stamps(settings, 5)
    for wall_s in (1_800_000_000, 1_700_000_000, 0):  # set back, and back
        monkeypatch.setattr("time.time_ns", lambda wall_s=wall_s: wall_s * 10**9)
        found += stamps(settings, 5)
    assert all(b > a for a, b in pairwise(found))
    assert not settings.path("stamp.new").exists()


@pytest.mark.parametrize("restarts", [3, 100])
def test_quick_restarts_do_not_bring_timestamps_ahead(settings: Config, restarts: int) -> None:
    for _ in range(restarts):
        (sent,) = stamps(settings, 1)
    assert sent <= (time.time_ns() - EPOCH_NS) // TICK_NS
    signing = Signing(settings, "fc")
    assert signing.accepts(heartbeat(peer(ahead=0)))
    assert signing.counts["wrongly signed"] == 0


def test_restarts_with_a_clock_that_was_set_back_do_not_add_up(settings: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    first = stamps(settings, 1)[0]
    monkeypatch.setattr("time.time_ns", lambda: 1_400_000_000 * 10**9)
    assert first < stamps(settings, 1)[0] <= first + MINUTE + 1
    for _ in range(20):
        (last,) = stamps(settings, 1)
    assert last < first + MINUTE + 21 * MINUTE // 50


def test_a_clock_that_is_set_back_in_a_run_is_continued_after_it(settings: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    wall = [1_800_000_000 * 10**9]
    monkeypatch.setattr("time.time_ns", lambda: wall[0])
    housekeeping = Housekeeping(settings, "fc")
    first, second = (housekeeping.due(0, alive=True)[0], housekeeping.due(SECOND, alive=True)[0])
    wall[0] -= 30 * 10**9
    third = housekeeping.due(2 * SECOND, alive=True)[0]
    wall[0] += 1 * 10**9
    (fourth,) = stamps(settings, 1)  # after a restart, with the clock still behind
    sent = [int.from_bytes(frame[-12:-6], "little") for frame in (first, second, third)]
    assert sent == sorted(set(sent))
    assert fourth > sent[-1]


def test_the_disk_is_written_once_a_minute(settings: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    wall = [1_800_000_000 * 10**9]
    monkeypatch.setattr("time.time_ns", lambda: wall[0])
    (first,) = stamps(settings, 1)
    assert settings.path("stamp").read_text() == f"{first} {first + MINUTE}\n"
    housekeeping, kept = Housekeeping(settings, "fc"), set[str]()
    for second in range(100):
        wall[0] += 10**9
        housekeeping.due(second * SECOND, alive=True)
        kept.add(settings.path("stamp").read_text())
    assert len(kept) == 2


def test_a_disk_that_fails_is_counted_and_stops_nothing(settings: Config) -> None:
    housekeeping = Housekeeping(settings, "fc")
    assert housekeeping.signing is not None
    settings.path("stamp.new").mkdir()
    assert len(parsed(housekeeping.due(0, alive=True)[0])) == 1
    assert housekeeping.signing.counts["timestamp not kept"] == 1


@pytest.mark.parametrize("key", [KEY.hex().encode(), KEY.hex().encode() + b"\n"])
def test_a_key_in_hex_digits(tmp_path: Path, key: bytes) -> None:
    assert Signing(signed(tmp_path, key=key), "fc").accepts(heartbeat(peer()))


@pytest.mark.parametrize("key", [b"", b"secret", KEY + b"\0", b"zz" * 32])
def test_no_key(tmp_path: Path, key: bytes) -> None:
    with pytest.raises(ConfigError, match=r"signing_key_file: .*32 bytes, or 64 hex digits"):
        Signing(signed(tmp_path, key=key), "fc")


@pytest.mark.parametrize("mode", [0o644, 0o604, 0o602])
def test_a_key_that_every_user_can_read_is_refused(settings: Config, mode: int) -> None:
    settings.path("key").chmod(mode)
    with pytest.raises(ConfigError, match=r"signing_key_file: .*every user can read or write it; chmod o="):
        Signing(settings, "fc")


def test_what_is_missing_or_no_timestamp(settings: Config, tmp_path: Path) -> None:
    settings.path("stamp").write_text("yesterday")
    with pytest.raises(ConfigError, match=r"signing_timestamp_file: .*holds no timestamp"):
        Signing(settings, "fc")
    settings.path("key").unlink()
    with pytest.raises(ConfigError, match=r"signing_key_file: .*cannot be read"):
        Signing(settings, "fc")
    text = (tmp_path / "live.toml").read_text().replace('signing_timestamp_file = "stamp"', "")
    (tmp_path / "live.toml").write_text(text)
    with pytest.raises(ConfigError, match="signing needs both"):
        load(tmp_path / "live.toml")
