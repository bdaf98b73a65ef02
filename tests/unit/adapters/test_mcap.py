"""MCAP: what a reader of another make finds in a file, damage and its repair, the live recorder and its disk."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path
from threading import Event, Thread
from typing import Any

import msgspec
import numpy as np
import pytest

from fusiond.__main__ import SUCCESS, UNUSABLE, USAGE, main
from fusiond.config.outputs import Mcap
from fusiond.config.schema import Config
from fusiond.estimator.solution import Mode
from fusiond.messages.codec import decode
from fusiond.messages.csv import csv_row
from fusiond.messages.types import EventMessage, HealthMessage, InnovationMessage, Message, StateMessage
from tests.helpers.drive import LOGS, folder, messages, settings
from tests.helpers.live import Autopilot, aligned, configuration, running
from tests.helpers.live import drive as steer
from tests.helpers.network import free_port, udp

pytest.importorskip("mcap", reason="the extra mcap is not installed")

from mcap.reader import make_reader
from pymavlink.dialects.v20 import common

from fusiond.ports.outputs import OutputLost
from fusiond_adapters import mcap as ours
from fusiond_adapters.foxglove.converter import Converter, Record
from fusiond_adapters.host.bounded_folder import BoundedFolder
from fusiond_adapters.logs.play import mavlink_records
from fusiond_adapters.logs.tlog import STAMP
from fusiond_adapters.mcap import McapFile, McapRecorder, repair
from tests.helpers.disk import limited_files

DEADLINE = 15.0  # s
SECOND = 1_000_000_000
SEMI_MAJOR, FLATTENING = 6378137.0, 1 / 298.257223563  # of WGS-84, for this test's own arithmetic
Read = list[tuple[str, int, int, dict[str, Any]]]  # topic, log time, publish time, content


def read(path: Path) -> Read:
    """A file's messages, by the reader of MCAP's own makers, in the order written."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [
            (channel.topic, message.log_time, message.publish_time, json.loads(message.data))
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]


def of(found: Read, topic: str) -> list[dict[str, Any]]:
    return [content for name, _, _, content in found if name == f"/fusiond/{topic}"]


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Read, list[str], Path]:
    """What the command line wrote: the file read, the rows of the CSV, the file."""
    out = tmp_path_factory.mktemp("replayed")
    logs = [str(folder() / log) for log in LOGS]
    command = ["replay", "--config", str(folder() / "fusiond.toml"), *logs]
    assert main([*command, "--mcap", str(out / "a.mcap"), "--csv", str(out / "a.csv")]) == SUCCESS
    return read(out / "a.mcap"), (out / "a.csv").read_text().splitlines()[1:], out / "a.mcap"


# --- What is not in a file


@pytest.mark.parametrize(
    ("boot_us", "force", "updated"),
    [(64_000_000, math.nan, 0x3F), (964_000_000, 0.0, 0x3F), (64_000_000, 0.0, 0)],
    ids=["not a number", "stamped in the future", "nothing updated"],
)
def test_a_drive_with_an_unusable_inertial_sample_can_be_written(
    tmp_path: Path, boot_us: int, force: float, updated: int
) -> None:
    """It is no measurement that is judged, so it has no topic."""
    records = list(mavlink_records(folder() / "drive.tlog"))
    at = len(records) // 2
    rest = (*(0.0,) * 7, updated, 0)
    sample = common.MAVLink_highres_imu_message(boot_us, force, 0.0, -9.81, 0.0, 0.0, 0.0, *rest)
    records.insert(at, (records[at][0], bytes(sample.pack(common.MAVLink(None, srcSystem=1, srcComponent=1)))))
    (tmp_path / "drive.tlog").write_bytes(b"".join(STAMP.pack(t_ns // 1000) + frame for t_ns, frame in records))
    logs = [str(tmp_path / "drive.tlog"), str(folder() / "drive.log")]
    command = ["replay", "--config", str(folder() / "fusiond.toml"), *logs]
    assert main([*command, "--mcap", str(tmp_path / "a.mcap"), "--json", str(tmp_path / "a.json")]) == SUCCESS
    imu = json.loads((tmp_path / "a.json").read_bytes())["sources"]["imu0"]
    assert imu["invalid"] == 1
    assert len(read(tmp_path / "a.mcap")) > 1000


def test_a_record_of_an_unknown_topic_is_counted_and_left_out(tmp_path: Path) -> None:
    with McapFile(tmp_path / "a.mcap", settings()) as file:
        file.add(Record("/fusiond/innovations/imu0", 1, b"{}"))
        file.add(Record("/fusiond/log", 1, b"{}"))
        assert file.unknown == 1
    assert [topic for topic, *_ in read(tmp_path / "a.mcap")] == ["/fusiond/log"]


# --- What is in a file


def test_every_state_is_that_of_the_track(replayed: tuple[Read, list[str], Path]) -> None:
    found, rows, _ = replayed
    states = [decode(json.dumps(state).encode(), StateMessage, "json") for state in of(found, "state")]
    assert len(rows) > 350 and [csv_row(state) for state in states] == rows
    for topic, log_ns, publish_ns, content in found:
        if topic == "/fusiond/state":
            assert log_ns == publish_ns == content["t_ns"]


def test_everything_published_is_there(replayed: tuple[Read, list[str], Path]) -> None:
    found, _, _ = replayed
    counts = {kind: sum(type(m) is kind for m in messages()) for kind in (InnovationMessage, EventMessage, HealthMessage)}
    assert len(of(found, "health")) == counts[HealthMessage] > 5
    assert len(of(found, "events")) == len(of(found, "log")) == counts[EventMessage] > 5
    innovations = [content for topic, *_, content in found if topic.startswith("/fusiond/innovations/")]
    assert len(innovations) == counts[InnovationMessage] > 1000
    assert {"rear_left", "gps0.position"} < {content["source"] for content in innovations}
    assert of(found, "innovations/gps0/position")[-1]["test_ratio"] > 0
    assert any(log["message"] == "mode: nominal -> dead_reckoning" and log["level"] == 3 for log in of(found, "log"))
    ticks = [publish_ns for _, _, publish_ns, _ in found]
    assert ticks == sorted(ticks)
    for topic, log_ns, publish_ns, content in found:
        assert log_ns == publish_ns  # by MCAP's definition: when it was recorded, and when it was published
        if topic == "/fusiond/settled" or topic.startswith("/fusiond/innovations/"):
            assert content["t_ns"] <= log_ns


def ecef(lat_deg: float, lon_deg: float, height: float) -> np.ndarray:
    lat, lon, e2 = math.radians(lat_deg), math.radians(lon_deg), FLATTENING * (2 - FLATTENING)
    n = SEMI_MAJOR / math.sqrt(1 - e2 * math.sin(lat) ** 2)
    return np.array([
        (n + height) * math.cos(lat) * math.cos(lon),
        (n + height) * math.cos(lat) * math.sin(lon),
        (n * (1 - e2) + height) * math.sin(lat),
    ])  # fmt: skip


def enu_axes(lat_deg: float, lon_deg: float) -> np.ndarray:
    """Rows: east, north, up in earth-fixed axes."""
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    return np.array([east, np.cross(up, east), up])


def rotation(w: float, x: float, y: float, z: float) -> np.ndarray:
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def test_poses_and_fixes_are_the_states_in_other_frames(replayed: tuple[Read, list[str], Path]) -> None:
    found, _, _ = replayed
    states = {state["t_ns"]: state["state"] for state in of(found, "state") if state["state"]}
    origin = of(found, "origin")[0]
    home = ecef(origin["latitude"], origin["longitude"], origin["altitude"])
    axes = enu_axes(origin["latitude"], origin["longitude"])
    shown = [row for row in found if row[0] in ("/fusiond/pose", "/fusiond/tf", "/fusiond/location")]
    assert len(shown) == 3 * len(states)
    for topic, t_ns, _, content in shown:
        state = states[t_ns]
        assert (content["timestamp"]["sec"], content["timestamp"]["nsec"]) == divmod(t_ns, SECOND)
        if topic == "/fusiond/location":
            c = np.array(state["covariance_position_m2"]).reshape(3, 3)
            swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
            place = (content["latitude"], content["longitude"], content["altitude"])
            assert place == (state["lat_deg"], state["lon_deg"], state["height_m"])
            assert np.allclose(np.array(content["position_covariance"]).reshape(3, 3), swap @ c @ swap.T, rtol=1e-12)
            assert content["position_covariance_type"] == 3
            continue
        where = content["pose"]["position"] if topic == "/fusiond/pose" else content["translation"]
        turned = content["pose"]["orientation"] if topic == "/fusiond/pose" else content["rotation"]
        here = enu_axes(state["lat_deg"], state["lon_deg"])
        expected = axes @ (ecef(state["lat_deg"], state["lon_deg"], state["height_m"]) - home)
        assert np.allclose([where[axis] for axis in "xyz"], expected, atol=1e-6)
        ned_in_enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
        mat = axes @ here.T @ ned_in_enu @ rotation(*state["quaternion_nb"]) @ np.diag([1, -1, -1])
        assert np.allclose(rotation(*(turned[axis] for axis in "wxyz")), mat, atol=1e-9)


def test_the_same_messages_give_the_same_bytes(replayed: tuple[Read, list[str], Path], tmp_path: Path) -> None:
    write(tmp_path / "b.mcap", messages())
    assert (tmp_path / "b.mcap").read_bytes() == replayed[2].read_bytes()


def write(path: Path, published: tuple[Message, ...]) -> list[Record]:
    """All of the messages into a file, as `replay --mcap` does; the records that went in."""
    converter = Converter()
    records = [record for message in published for record in converter.records(message)]
    with McapFile(path, settings()) as file:
        for record in records:
            file.add(record)
    return records


def test_the_configuration_is_in_the_file(replayed: tuple[Read, list[str], Path]) -> None:
    with replayed[2].open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    assert (metadata.name, metadata.metadata["vehicle"]) == ("fusiond", "tested")
    assert json.loads(metadata.metadata["config"])["vehicle"]["name"] == "tested"


def test_a_file_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [str(folder() / log) for log in LOGS]
    command = ["replay", "--config", str(folder() / "fusiond.toml"), *logs, "--mcap"]
    (tmp_path / "folder.mcap").mkdir()
    assert main([*command, str(tmp_path / "folder.mcap")]) == UNUSABLE
    assert "folder.mcap: cannot be written" in capsys.readouterr().err
    assert main([*command, logs[0]]) == USAGE
    with limited_files(50_000):
        assert main([*command, str(tmp_path / "a.mcap")]) == UNUSABLE
    assert "a.mcap: File too large" in capsys.readouterr().err


# --- Damage


def test_a_file_cut_anywhere_is_repaired_up_to_there(tmp_path: Path) -> None:
    published = messages()[:1000]
    records = write(tmp_path / "whole.mcap", published)
    data = (tmp_path / "whole.mcap").read_bytes()
    expected = [(record.topic, record.publish_ns, record.publish_ns, json.loads(record.data)) for record in records]
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    most = 0
    for length in [*range(0, 300, 23), *np.linspace(300, len(data) - 1, 20).astype(int).tolist(), len(data)]:
        cut.write_bytes(data[:length])
        count, reason = repair(cut, mended)
        found = read(mended)
        assert found == expected[:count] and count >= most and (reason is not None or count == len(expected))
        most = count
    assert most == len(expected)


def test_flipped_bytes_only_end_the_repair(tmp_path: Path) -> None:
    records = write(tmp_path / "whole.mcap", messages()[:1500])
    data = bytearray((tmp_path / "whole.mcap").read_bytes())
    data[len(data) // 2] ^= 0x55
    (tmp_path / "cut.mcap").write_bytes(data)
    count, reason = repair(tmp_path / "cut.mcap", tmp_path / "mended.mcap")
    assert 0 < count < len(records) and reason


def test_the_command_that_repairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "whole.mcap", messages()[:1500])
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "whole.mcap").read_bytes()[:-100_000])
    arguments = [str(tmp_path / "cut.mcap"), str(tmp_path / "mended.mcap")]
    assert ours.main(arguments) == 0
    assert f"messages in {arguments[1]}; the rest is unusable" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        ours.main(arguments)
    assert ours.main([str(tmp_path / "none.mcap"), str(tmp_path / "other.mcap")]) == 1


# --- The live recorder


@contextmanager
def recording(recorder: McapRecorder) -> Iterator[list[OutputLost]]:
    """A session in a thread; what it raised."""
    stop, lost = Event(), list[OutputLost]()

    def run() -> None:
        try:
            recorder.session(stop)
        except OutputLost as error:
            lost.append(error)

    thread = Thread(target=run)
    thread.start()
    try:
        yield lost
    finally:
        stop.set()
        recorder.outbox.rouse()
        thread.join(DEADLINE)
        assert not thread.is_alive()


def recorder(tmp_path: Path, **keys: Any) -> McapRecorder:
    section = Mcap(folder=str(tmp_path / "out"), **keys)
    config: Config = msgspec.structs.replace(settings(), mcap=section)
    return McapRecorder(config, tmp_path / "out")


def files_of(tmp_path: Path) -> list[Path]:
    return sorted((tmp_path / "out").iterdir())


def test_the_recorder_writes_what_a_replay_writes(replayed: tuple[Read, list[str], Path], tmp_path: Path) -> None:
    output = recorder(tmp_path)
    with recording(output) as lost:
        for message in messages():
            output.outbox.put(message)
    (file,) = files_of(tmp_path)
    assert not lost and read(file) == replayed[0][: len(read(file))]
    assert output.counts() == {"records": len(read(file)), "records lost": 0, "files": 1}
    assert re.fullmatch(r"0001-\d{8}T\d{6}\.\d{6}Z-fusion\.mcap", file.name)


def test_files_follow_one_another_within_their_limit(tmp_path: Path) -> None:
    output = recorder(tmp_path, file_mb=0.5, total_mb=1)
    output._file_bytes = 300_000  # less than one may configure: the drive is short
    output._bounded = BoundedFolder(tmp_path / "out", re.escape(ours.KIND), 300_000, 800_000)
    mine = tmp_path / "out" / "mine.mcap"
    mine.parent.mkdir()
    mine.write_bytes(bytes(1_000_000))
    with recording(output) as lost:
        for message in messages():
            output.outbox.put(message)
    files = [file for file in files_of(tmp_path) if file != mine]
    assert not lost and mine.exists() and output.files > len(files) >= 2
    assert sum(file.stat().st_size for file in files) <= 800_000
    contents = [read(file) for file in files]
    assert all(len(found) > 50 for found in contents)
    for before, after in pairwise(contents):
        assert before[-1][2] <= after[0][2]


def test_a_crash_costs_the_last_second(tmp_path: Path) -> None:
    """The file as it lies on disk while the recorder is at work."""
    published = messages()[:2500]
    last = next(message for message in reversed(published) if isinstance(message, StateMessage))
    with McapFile(tmp_path / "open.mcap", settings()) as file:
        converter = Converter()
        for message in published:
            for record in converter.records(message):
                file.add(record)
        (tmp_path / "cut.mcap").write_bytes((tmp_path / "open.mcap").read_bytes())
    count, reason = repair(tmp_path / "cut.mcap", tmp_path / "mended.mcap")
    assert count and reason
    assert last.t_ns - max(publish_ns for _, _, publish_ns, _ in read(tmp_path / "mended.mcap")) < SECOND


def test_a_full_disk_is_counted_and_survived(tmp_path: Path) -> None:
    output = recorder(tmp_path)
    published = messages()
    converter = Converter()
    total = len([record for message in published for record in converter.records(message)])
    with limited_files(60_000), recording(output) as lost:
        for message in published[:3000]:
            output.outbox.put(message)
    assert "File too large" in str(lost[0]) and "fusion.mcap" in str(lost[0])
    (first,) = files_of(tmp_path)
    assert first.stat().st_size <= 60_000
    count, _ = repair(first, tmp_path / "mended.mcap")
    assert count == output.counts()["records"] > 0
    with recording(output) as lost:
        for message in published[3000:]:
            output.outbox.put(message)
    assert not lost and len(files_of(tmp_path)) == 2
    counts = output.counts()
    assert counts["records lost"] > 0 and counts["records"] + counts["records lost"] == total
    assert count + len(read(files_of(tmp_path)[1])) == counts["records"]


def test_a_disk_that_is_full_from_the_start_leaves_no_litter(tmp_path: Path) -> None:
    output = recorder(tmp_path)
    for _ in range(3):
        with limited_files(100), recording(output) as lost:
            for message in messages()[:1000]:
                output.outbox.put(message)
        assert lost
    assert files_of(tmp_path) == [] and output.counts()["records"] == 0


def test_states_are_thinned_but_not_events(tmp_path: Path) -> None:
    output = recorder(tmp_path, rate_hz=5.0)
    with recording(output):
        for message in messages():
            output.outbox.put(message)
    (file,) = files_of(tmp_path)
    found = read(file)
    states = of(found, "state")
    modes = [state["mode"] for state in states]
    span = (states[-1]["t_ns"] - states[0]["t_ns"]) / SECOND
    assert len(states) == pytest.approx(5 * span, abs=4)
    assert list(dict.fromkeys(modes))[:2] == ["aligning", "nominal"]
    everything = [m for m in messages() if isinstance(m, StateMessage)]
    turned = next(b.t_ns for a, b in pairwise(everything) if a.mode != b.mode)
    assert turned in {state["t_ns"] for state in states}  # at once, not at its turn
    assert len(of(found, "events")) == sum(isinstance(m, EventMessage) for m in messages())


def test_a_daemon_that_is_stopped_closes_its_file(tmp_path: Path) -> None:
    port = free_port()
    more = '[mcap]\nfolder = "out"\n'
    config = configuration(tmp_path, f"udpin:127.0.0.1:{port}", more)
    with running(config) as run, closing(udp(port)[0]) as peer:
        steer(run, lambda data: peer.sendto(data, ("127.0.0.1", port)), None, lambda: aligned(run), Autopilot())
        published = run.messages
    (file,) = files_of(tmp_path)
    with file.open("rb") as opened:
        assert make_reader(opened).get_summary() is not None  # the index, written last
    states = [decode(json.dumps(state).encode(), StateMessage, "json") for state in of(read(file), "state")]
    assert states == published and states[-1].mode is Mode.NOMINAL
    assert run.daemon.outputs["mcap"].counts()["records lost"] == 0
