"""The state file: replaced atomically, ignored if unusable; and the daemon that writes it and starts from it."""

from __future__ import annotations

import errno
import logging
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import count
from pathlib import Path

import can
import msgspec
import numpy as np
import pytest

from fusiond.__main__ import main
from fusiond.app.diagnosis.finding import NO_STATE
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.app.state_file import StateFile, read_state
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.estimator.solution import Mode
from fusiond.filter.hot_start import Verdict
from fusiond.filter.state import T
from fusiond.filter.stored_state import StoredState, from_text, stored_state, to_text, with_frame
from fusiond.messages.codec import encode
from fusiond.messages.types import StateMessage
from fusiond_adapters.logs.merge import open_logs
from tests.helpers import streams
from tests.helpers.live import Autopilot, Running, aligned, configuration, drive, running
from tests.helpers.network import free_port, udp
from tests.helpers.streams import running_state

KEEP = '[state]\nfile = "state.json"\nevery_s = 1\n'
CHANNELS = count()
NOW = 1_800_000_000_000_000_000  # ns
DAY = 86_400_000_000_000  # ns


def disk_full(_: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=f"state-{next(CHANNELS)}") as opened:
        yield opened


def settings(folder: Path, port: int, bus: can.BusABC, more: str = "") -> Config:
    """A vehicle at rest with a state file and a configured heading."""
    channel = str(bus.channel_info).rpartition(" ")[2]
    return configuration(folder, f"udpin:127.0.0.1:{port}", KEEP + more, channel)


def without_heading(folder: Path) -> Config:
    file = folder / "live.toml"
    file.write_text(file.read_text().replace("heading_deg = 30.0\n", ""))
    return config.load(file)


def stand(run: Running, port: int, bus: can.BusABC, until: Callable[[], bool]) -> None:
    """Play a vehicle at rest until a condition holds."""
    peer, send = udp(port)
    with closing(peer):
        drive(run, send, bus, until, Autopilot())


def last(run: Running) -> Mode | None:
    return run.messages[-1].mode if run.messages else None


def note(run: Running) -> str:
    """The note on the stored state in the health."""
    return run.daemon.health.outputs["state"].notes["hot_start"] if run.daemon.health else ""


def leave_a_state(folder: Path, bus: can.BusABC) -> StoredState:
    """The file on disk during a first run with a configured heading, as a kill would leave it."""
    port, file = free_port(), folder / "state.json"
    with running(settings(folder, port, bus)) as run:
        stand(run, port, bus, lambda: file.exists() and b'"at_rest": true' in file.read_bytes())
        killed = file.read_bytes()
    assert from_text(file.read_bytes()).t_ns >= from_text(killed).t_ns  # written again at the orderly end
    file.write_bytes(killed)
    return from_text(killed)


def test_killed_and_started_again(tmp_path: Path, bus: can.BusABC) -> None:
    """The stored heading is used at once; and the recording replays to the same bytes."""
    leave_a_state(tmp_path, bus)
    port = free_port()
    settings(tmp_path, port, bus, '[record]\nfolder = "box"\n')
    hot = without_heading(tmp_path)
    with running(hot) as run:
        stand(run, port, bus, lambda: sum(m.mode is Mode.NOMINAL for m in run.messages) > 50 and "same place" in note(run))
    state = run.messages[-1].state
    assert state is not None and abs(state.yaw_deg - 30.0) < 2.0
    (state_file,) = (tmp_path / "box").glob("*Z-state.json")
    box = sorted((tmp_path / "box").glob("*log"))
    again = replayed(hot, box, read_state(state_file))
    assert len(again) > 50
    assert again == [encode(message, "json") for message in run.messages[: len(again)]]
    logs, csv = [str(path) for path in box], tmp_path / "track.csv"
    more = ["--stored", str(state_file), "--csv", str(csv)]
    assert main(["replay", "--config", str(tmp_path / "live.toml"), *logs, *more]) == 0
    assert ",nominal\n" in csv.read_text()
    assert main(["replay", "--config", str(tmp_path / "live.toml"), *logs, "--csv", str(csv)]) == NO_STATE
    assert ",nominal\n" not in csv.read_text()
    for wrong in (tmp_path / "none.json", tmp_path / "live.toml"):
        assert main(["replay", "--config", str(tmp_path / "live.toml"), *logs, "--stored", str(wrong)]) == 1


def replayed(setup: Config, logs: list[Path], stored: StoredState | None) -> list[bytes]:
    published: list[bytes] = []

    def keep(message: StateMessage, _: object) -> None:
        published.append(encode(message, "json"))

    task = ReplayTask(setup.publish.rate_hz, on_tick=[keep], stored_state=stored)
    Replay(setup, task).run(open_logs([str(path) for path in logs], setup))
    return published


def test_a_torn_file_is_a_cold_start(tmp_path: Path, bus: can.BusABC, caplog: pytest.LogCaptureFixture) -> None:
    leave_a_state(tmp_path, bus)
    file, port = tmp_path / "state.json", free_port()
    torn = file.read_bytes()[:-200]
    file.write_bytes(torn)
    settings(tmp_path, port, bus)
    with caplog.at_level(logging.WARNING, "fusiond"), running(without_heading(tmp_path)) as run:
        stand(run, port, bus, lambda: run.daemon.health is not None and gathered(run) > 100)
        assert last(run) is Mode.ALIGNING
        assert "ignored: torn or altered" in note(run)
        assert run.daemon.live.engine.fusion.totals()["FUSED"] == 0  # there was no state to go into
    assert sum("stored state ignored" in record.message for record in caplog.records) == 1
    assert (tmp_path / "state.json.damaged").read_bytes() == torn  # to be looked into; a later state does not replace it


def gathered(run: Running) -> int:
    return run.daemon.live.engine.fusion.totals()["GATHERED"]


def test_a_full_disk_is_counted_and_stops_nothing(
    tmp_path: Path, bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = free_port()
    monkeypatch.setattr(os, "fsync", disk_full)
    with running(settings(tmp_path, port, bus)) as run:
        stand(run, port, bus, lambda: run.daemon.health is not None and run.daemon.health.outputs["state"].dropped >= 1)
        assert last(run) is Mode.NOMINAL
        assert run.daemon.health is not None
        assert run.daemon.health.outputs["state"].notes["error"] == "No space left on device"
        assert run.daemon.losses()["states not stored"] >= 1
    assert not list(tmp_path.glob("state.json*"))


# --- The file alone


def left(t_ns: int, setup: Config) -> StoredState:
    """A state of an instant."""
    state = running_state(np.random.default_rng(1))
    state.stamps[T] = t_ns
    return stored_state(state, setup)


def test_it_is_replaced_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, first, second = tmp_path / "new" / "state.json", left(NOW - DAY, streams.config()), left(NOW, streams.config())
    file = StateFile(path, streams.config(), NOW)
    assert file.stored is None and file.health(Verdict.NONE).notes == {"hot_start": "ignored: there is none yet"}
    file.write(first)
    assert StateFile(path, streams.config(), NOW).stored == first
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", disk_full)
        file.write(second)
    assert (file.written, file.lost, file.error) == (1, 1, "No space left on device")
    assert [left.name for left in path.parent.iterdir()] == ["state.json"]
    assert read_state(path) == first
    file.write(second)
    assert (file.written, file.lost, file.error) == (2, 1, None)
    assert read_state(path) == second


@pytest.mark.parametrize(
    ("age_ns", "tables", "reason"),
    [
        (8 * DAY, {}, "it is 192.0 h old"),
        (-DAY, {}, "it is from the future, by 86400 s"),
        (DAY, {"vehicle": {"name": "other"}}, "it is of the vehicle 'vehicle'"),
        (DAY, {"gnss": {"delay_ms": 50.0}}, "the sensors are configured otherwise than they were"),
    ],
)
def test_an_unusable_file_is_ignored(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, age_ns: int, tables: dict[str, dict[str, object]], reason: str
) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(to_text(left(NOW - age_ns, streams.config())))
    with caplog.at_level(logging.WARNING, "fusiond"):
        file = StateFile(path, streams.config(**tables), NOW)
    assert file.stored is None
    assert file.health(Verdict.NONE).notes["hot_start"] == f"ignored: {reason}"
    assert [record.message for record in caplog.records] == [f"stored state ignored: {path}: {reason}"]


@pytest.mark.parametrize("content", [b"", b"null", b"[]", b"{}", b'{"version": 9}', b"\xff\xfe", b"x" * 2_000_000])
def test_garbage_is_ignored(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(content)
    assert StateFile(path, streams.config(), NOW).stored is None


def altered(stored: StoredState, **fields: object) -> bytes:
    """A stored state with other contents, under a checksum that is right."""
    made = msgspec.structs.replace(stored, checksum=0, **fields)
    return to_text(msgspec.structs.replace(made, checksum=zlib.crc32(msgspec.json.encode(made))))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"calibrations": [0.0]}, "it has 1 calibrations and 6 variances of them"),
        ({"calibrations": [0.0] * 8, "calibration_variances": [0.0] * 8}, "it has 8 calibrations and 8 variances of them"),
        ({"calibrations": [], "calibration_variances": []}, "it has 0 calibrations and 0 variances of them"),
        ({"height": 1e300}, r"Expected `float` <= 1000000.0 - at `$.height`"),
        ({"gyro_bias": (1e9, 0.0, 0.0)}, r"Expected `float` <= 100.0 - at `$.gyro_bias[0]`"),
        ({"yaw": 40.0}, r"Expected `float` <= 4.0 - at `$.yaw`"),
    ],
)
def test_a_right_checksum_does_not_make_up_for_a_wrong_shape(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, fields: dict[str, object], reason: str
) -> None:
    """It is set aside, and the next start finds no file: whatever it holds, it cannot end the daemon twice."""
    path, content = tmp_path / "state.json", altered(left(NOW - DAY, streams.config()), **fields)
    path.write_bytes(content)
    with caplog.at_level(logging.WARNING, "fusiond"):
        assert StateFile(path, streams.config(), NOW).stored is None
    aside = tmp_path / "state.json.damaged"
    assert caplog.messages == [f"stored state ignored: {path}: torn or altered: {reason}; kept as {aside}"]
    assert aside.read_bytes() == content and not path.exists()
    file = StateFile(path, streams.config(), NOW)
    file.write(left(NOW, streams.config()))
    assert file.written == 1 and aside.read_bytes() == content


def test_a_folder_in_its_place_is_reported(tmp_path: Path) -> None:
    file = StateFile(tmp_path, streams.config(), NOW)
    assert file.health(Verdict.NONE).notes["hot_start"] == "ignored: cannot be read: Is a directory"
    file.write(left(NOW, streams.config()))
    assert file.lost == 1


# --- The local frame of an autopilot

TO_AUTOPILOT = '[autopilot]\nlink = "fc"\nunconfirmed_heading = true\n'


def test_the_local_frame_goes_on_in_the_next_run(tmp_path: Path, bus: can.BusABC) -> None:
    """Also after a run that died before it had a state; and where the sensors are configured otherwise, so that the state
    itself is of no use."""
    file, port = tmp_path / "state.json", free_port()
    with running(settings(tmp_path, port, bus, TO_AUTOPILOT)) as run:
        stand(run, port, bus, lambda: file.exists() and from_text(file.read_bytes()).origin is not None)
    first = from_text(file.read_bytes())
    assert first.origin == pytest.approx((48.1374300, 11.5754900, 563.0), abs=1e-3)
    assert first.reset_counter is not None
    with running(settings(tmp_path, port, bus, TO_AUTOPILOT)) as run:
        run.until(lambda: from_text(file.read_bytes()).reset_counter != first.reset_counter)
        assert not aligned(run)
    second = from_text(file.read_bytes())
    assert second == with_frame(first, first.origin, (first.reset_counter + 128) % 256)
    toml = tmp_path / "live.toml"
    toml.write_text(toml.read_text().replace('stamp = "arrival"', 'stamp = "arrival"\nlever_arm_m = [1.0, 0.0, 0.0]'))
    unusable = StateFile(file, config.load(toml), second.t_ns + DAY)
    assert unusable.stored is None
    assert (unusable.frame.origin, unusable.frame.reset_counter) == (first.origin, second.reset_counter)
