"""The command line: its output, its errors, and that no input makes it crash."""

from __future__ import annotations

import gzip
import random
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
import zenoh

from fusiond.__main__ import INTERRUPTED, SUCCESS, UNUSABLE, USAGE, main
from fusiond.app.demo.demo import explanation
from fusiond.app.diagnosis.finding import CONTRADICTED, NO_STATE
from fusiond.app.replay.summary import Summary
from fusiond.config.outputs import Zenoh
from fusiond.messages.codec import decode
from fusiond.messages.csv import csv_row
from fusiond.messages.types import StateMessage
from fusiond_adapters.zenoh.session import open_session, state_key

HEADER = (
    "unix_us,lat_deg,lon_deg,height_m,vn_mps,ve_mps,vd_mps,roll_deg,pitch_deg,yaw_deg,"
    "sigma_n_m,sigma_e_m,sigma_d_m,sigma_v_mps,sigma_yaw_deg,mode"
)
DRIVE = """
[[segment]]
duration_s = 8
turn_deg = 30.0
[start]
speed_mps = 9.0
[vehicle]
name = "tested"
[gnss]
outage_s = [[4.5, 8]]
"""
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short simulated drive, made by the command line itself."""
    path = tmp_path_factory.mktemp("drive")
    (path / "scenario.toml").write_text(DRIVE)
    assert main(["simulate", "--config", str(path / "scenario.toml"), "--out", str(path)]) == SUCCESS
    return path


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command line in this process: exit code, stdout, stderr."""

    def command(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as ended:  # argparse
            code = int(ended.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return command


@pytest.fixture
def replay(run: Run, folder: Path) -> Run:
    """`fusiond replay` of the drive; arguments that are logs by their suffix replace its own."""

    def command(*arguments: object) -> tuple[int, str, str]:
        logs = [a for a in map(str, arguments) if a.removesuffix(".gz").endswith((".tlog", ".log"))]
        others = [a for a in map(str, arguments) if a not in logs]
        logs = logs or [str(folder / "drive.tlog"), str(folder / "drive.log")]
        return run("replay", "--config", folder / "fusiond.toml", *logs, *others)

    return command


# --- Output


def test_replay_writes_track_summary_and_text(replay: Run, folder: Path, tmp_path: Path) -> None:
    track, figures = tmp_path / "track.csv", tmp_path / "summary.json"
    code, out, err = replay("--csv", track, "--json", figures, "--truth", folder / "truth.csv", "--window", "2-8")
    assert (code, err) == (SUCCESS, "")
    header, *rows = track.read_text().splitlines()
    assert header == HEADER
    assert all(row.count(",") == 15 for row in rows)
    assert rows[0].endswith(",,,aligning")
    summary = msgspec.json.decode(figures.read_bytes(), type=Summary)
    assert summary.published is not None
    assert summary.published.rows == len(rows)
    first, last = summary.span.first_ns, summary.span.last_ns
    assert [int(row.split(",")[0]) for row in rows] == [t_ns // 1000 for t_ns in range(first, last + 1, 20_000_000)]
    assert summary.truth is not None
    assert summary.truth.position.rmse_m < 3.0
    assert summary.truth.heading.rmse_deg < 3.0
    assert list(summary.logs) == ["drive.tlog", "drive.log"]
    for part in ("tested: 8.1 s", "gps0.position", "final state", "compared with the truth, seconds 2.0 to"):
        assert part in out


def test_the_same_inputs_give_the_same_bytes(replay: Run, folder: Path, tmp_path: Path) -> None:
    written = []
    for name in ("a", "b"):
        where = tmp_path / name
        where.mkdir()
        outputs = [where / "t.csv", where / "s.json"]
        assert replay("--csv", outputs[0], "--json", outputs[1], "--truth", folder / "truth.csv")[0] == SUCCESS
        written.append([path.read_bytes() for path in outputs])
    assert written[0] == written[1]
    assert str(tmp_path).encode() not in written[0][1]
    assert str(folder).encode() not in written[0][1]


def test_gzipped_logs_and_truth_give_the_same_track(replay: Run, folder: Path, tmp_path: Path) -> None:
    for name in ("drive.tlog", "drive.log", "truth.csv"):
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress((folder / name).read_bytes()))
    plain, packed = tmp_path / "plain.csv", tmp_path / "packed.csv"
    _, plain_text, _ = replay("--csv", plain, "--truth", folder / "truth.csv")
    zipped = [tmp_path / "drive.tlog.gz", tmp_path / "drive.log.gz"]
    code, packed_text, _ = replay(*zipped, "--csv", packed, "--truth", tmp_path / "truth.csv.gz")
    assert code == SUCCESS
    assert plain.read_bytes() == packed.read_bytes()
    assert plain_text.split("compared with the truth")[1] == packed_text.split("compared with the truth")[1]


def test_rate_and_withheld_sources(replay: Run, tmp_path: Path) -> None:
    track, figures = tmp_path / "track.csv", tmp_path / "summary.json"
    withheld = ["--withhold", "gps0:3-4", "--withhold", "rear_left:0-9"]
    code, out, _ = replay("--rate", 5, "--csv", track, "--json", figures, *withheld)
    assert code == SUCCESS
    assert len(track.read_text().splitlines()) == 1 + 8 * 5 + 1
    sources = msgspec.json.decode(figures.read_bytes(), type=Summary).sources
    assert sources["gps0.position"].withheld == sources["gps0.velocity"].withheld == 5
    assert sources["rear_left"].withheld == sources["rear_left"].events > 0
    assert "withheld" in out


def test_plot_is_a_png(replay: Run, folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    picture = tmp_path / "errors.png"
    assert replay("--plot", picture, "--truth", folder / "truth.csv")[0] == SUCCESS
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_publish_sends_the_rows_of_the_csv(replay: Run, run: Run, folder: Path, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    text = (folder / "fusiond.toml").read_text()
    setup = folder / "publishing.toml"
    setup.write_text(f'{text}\n[zenoh]\nmode = "client"\nlisten = []\nconnect = ["{endpoint}"]\n')
    received: list[bytes] = []

    def keep(sample: zenoh.Sample) -> None:
        received.append(sample.payload.to_bytes())

    logs = [folder / "drive.tlog", folder / "drive.log"]
    with open_session(Zenoh(listen=[endpoint])) as session, session.declare_subscriber(state_key("tested"), keep):
        track = tmp_path / "track.csv"
        code, _, err = run("replay", "--config", setup, *logs, "--csv", track, "--publish", "--speed", 20)
    assert (code, err) == (SUCCESS, "")
    rows = track.read_text().splitlines()[1:]
    sent = [csv_row(decode(payload, StateMessage, "json")) for payload in received]
    assert sent  # the first ones may go out before the subscriber is known
    assert sent == [row for row in rows if row in set(sent)]
    assert len(sent) > len(rows) // 2


def test_demo_explains_a_summary_to_a_newcomer(replay: Run, folder: Path, tmp_path: Path) -> None:
    figures = tmp_path / "summary.json"
    replay("--json", figures, "--truth", folder / "truth.csv")
    text = "\n".join(explanation(msgspec.json.decode(figures.read_bytes(), type=Summary)))
    for part in ("WHAT WENT IN", "HOW LATE IT CAME", "HOW GOOD THE RESULT IS", "WITHOUT GNSS", "From second 4 to 8"):
        assert part in text
    assert "nan" not in text
    lines = re.findall(r"(\d+) measurements, (\d+) fused, (\d+) taken to find the start(?:, (\d+) not used)?", text)
    assert len(lines) == 7
    assert all(int(events) == sum(map(int, filter(None, parts))) for events, *parts in lines)


@pytest.mark.slow
def test_demo(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("demo", "--out", tmp_path / "out" / "demo")
    assert code == SUCCESS
    assert "WITH BAD GNSS" in out
    text = " ".join(out.split())
    assert re.search(r"A replay of the recording gives (\d+) of \1 identical states", text)
    assert ", 0 not received, 0 dropped from full queues" in text
    written = {path.name for path in (tmp_path / "out" / "demo").iterdir()}
    assert written == {"track.csv", "summary.json", "track.png"}


def test_check_explains_the_configuration(run: Run, folder: Path) -> None:
    code, out, err = run("check", "--config", folder / "fusiond.toml")
    assert (code, err) == (SUCCESS, "")
    for part in ("vehicle      tested", "WHEEL_SPEEDS.SPEED_FL", "fusiond/tested/state at 50 Hz", "can be used\n"):
        assert part in out


def test_check_warns_of_oddities(run: Run, folder: Path) -> None:
    odd = folder / "odd.toml"
    text = (folder / "fusiond.toml").read_text()
    odd.write_text(text.replace("velocity_delay_ms = 0", "velocity_delay_ms = 1500"))
    code, out, _ = run("check", "--config", odd)
    assert code == SUCCESS
    assert "gnss.gps0 (velocity): its delay of 1500 ms is not below filter.horizon_s (1 s)" in out
    bare = folder / "bare.toml"
    bare.write_text('[mavlink.fcu]\n[imu.imu0]\nlink = "fcu"\n')
    _, out, _ = run("check", "--config", bare)
    assert "no [gnss.NAME]" in out
    assert "no [wheel.NAME]" in out


def test_check_is_as_strict_as_run(run: Run, folder: Path) -> None:
    """Connection strings, interfaces, endpoints and links are wrong before anything is opened, all told at once."""
    text = (folder / "fusiond.toml").read_text()
    (folder / "strict.toml").write_text(
        text + '\n[mavlink.radio]\nconnection = "upd:127.0.0.1"\n[can.body]\ninterface = "socketkan"\n'
    )
    for command in ("check", "run"):
        code, out, err = run(command, folder / "strict.toml")
        assert (code, out) == (USAGE, ""), command
        assert "mavlink.radio.connection: 'upd:127.0.0.1': unknown kind of connection" in err
    radio = '\n[mavlink.radio]\nconnection = "udpin:127.0.0.1:14599"\n[can.body]\ninterface = "socketkan"\n'
    (folder / "strict.toml").write_text(text + radio)
    code, _, err = run("check", folder / "strict.toml")
    line = (text + radio).splitlines().index('interface = "socketkan"') + 1
    assert code == USAGE
    assert f"strict.toml:{line}: can.body.interface: python-can has no interface 'socketkan' (did you mean 'soc" in err
    for endpoint, complaint in (("tpc/127.0.0.1:7447", "did you mean 'tcp'?"), ("tcp/127.0.0.1:70000", "up to 65535")):
        (folder / "strict.toml").write_text(f'{text}\n[zenoh]\nlisten = ["{endpoint}"]\n')
        code, _, err = run("check", folder / "strict.toml")
        assert code == USAGE
        assert "zenoh.listen[0]: " in err and complaint in err


def test_how_much_check_tells(run: Run, folder: Path) -> None:
    assert run("check", "-q", folder / "fusiond.toml") == (SUCCESS, "", "")
    _, out, _ = run("check", "-v", folder / "fusiond.toml")
    assert "filter.horizon_s = 1.0\n" in out
    assert run("check", "-q", "-v", folder / "fusiond.toml")[0] == USAGE


def test_how_much_replay_tells(replay: Run) -> None:
    assert replay("-q") == (SUCCESS, "", "")
    _, out, _ = replay("-v")
    assert "log drive.tlog: " in out and "clock unix: " in out


@pytest.mark.parametrize(("option", "name"), [("--plot", "track.svg"), ("--plot", "track"), ("--mcap", "drive.bag")])
def test_a_suffix_of_another_format_is_refused(replay: Run, tmp_path: Path, option: str, name: str) -> None:
    code, _, err = replay(option, tmp_path / name)
    assert code == USAGE
    assert f"{option} {tmp_path / name}: what is written is" in err
    assert not list(tmp_path.iterdir())


def test_logs_of_one_name_are_distinguished(replay: Run, folder: Path, tmp_path: Path) -> None:
    lines = (folder / "drive.log").read_text().splitlines(keepends=True)
    halves = [lines[: len(lines) // 2], lines[len(lines) // 2 :]]
    for name, half in zip("ab", halves, strict=True):
        (tmp_path / name).mkdir()
        (tmp_path / name / "car.log").write_text("".join(half))
    figures = tmp_path / "summary.json"
    code, _, _ = replay(folder / "drive.tlog", tmp_path / "a" / "car.log", tmp_path / "b" / "car.log", "--json", figures)
    assert code == SUCCESS
    logs = msgspec.json.decode(figures.read_bytes(), type=Summary).logs
    assert {name: met.get("frames") for name, met in logs.items()} == {
        "drive.tlog": None,
        "car.log": len(halves[0]),
        "car.log (2)": len(halves[1]),
    }


def test_a_wrong_unit_is_named_by_doctor_and_by_replay(replay: Run, run: Run, folder: Path, tmp_path: Path) -> None:
    """With its line, and an exit code of its own; without findings the doctor says so."""
    text = (folder / "fusiond.toml").read_text()
    wrong = folder / "wrong.toml"
    wrong.write_text(text.replace('unit = "km/h"', 'unit = "m/s"', 1))
    logs = [folder / "drive.tlog", folder / "drive.log"]
    line = wrong.read_text().splitlines().index('unit = "m/s"') + 1
    figures = tmp_path / "summary.json"
    for command in ("doctor", "replay"):
        code, out, _ = run(command, wrong, *logs, "--json", figures)
        assert code == CONTRADICTED
        assert "times the speed by GNSS: is the unit km/h, not m/s?" in out
        assert f'wrong.toml:{line}: wheel.front_left.unit = "km/h"' in out
        (finding,) = msgspec.json.decode(figures.read_bytes(), type=Summary).findings
        assert (finding.kind, finding.key) == ("wheel_unit", "wheel.front_left.unit")
    code, out, err = run("doctor", folder / "fusiond.toml", *logs)
    assert (code, err) == (SUCCESS, "")
    assert "s of data contradict nothing" in out
    assert run("doctor", "-q", folder / "fusiond.toml", *logs) == (SUCCESS, "", "")


def test_a_replay_without_a_state_says_why(run: Run, folder: Path) -> None:
    code, out, _ = run("replay", folder / "fusiond.toml", folder / "drive.log")
    assert code == NO_STATE
    assert "final state    none: no log of mavlink.fcu is given" in out


# --- Errors


def test_help_and_version(run: Run) -> None:
    assert run("--version") == (SUCCESS, "fusiond 0.1.0\n", "")
    for command in ("replay", "check", "simulate", "demo"):
        code, out, _ = run(command, "--help")
        assert code == SUCCESS
        assert f"fusiond {command}" in out
        assert "example" in out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--withhold", "gps9:1-2"], "there is no source 'gps9'; configured: gps0"),
        (["--withhold", "gps0:2-1"], "is not an interval"),
        (["--window", "1-2"], "give --truth as well"),
        (["--rate", "0"], "between 0.001 and 1000 Hz"),
        (["--rate", "fast"], "'fast' is not a number"),
        (["--speed", "-1"], "must be above 0"),
        (["--nonsense"], "unrecognized arguments"),
    ],
)
def test_wrong_usage(replay: Run, arguments: list[str], complaint: str) -> None:
    code, _, err = replay(*arguments)
    assert code == USAGE
    assert complaint in err


def test_wrong_configuration_is_reported_by_line(run: Run, folder: Path) -> None:
    for text, complaint in (
        ("[vehicle\n", "not valid TOML"),
        ("[vehicle]\nnam = 'x'\n", "bad.toml:2: vehicle.nam: unknown key (did you mean 'name'?); allowed: geoid_m, name"),
    ):
        (folder / "bad.toml").write_text(text)
        for command in (["check"], ["replay", str(folder / "drive.tlog")], ["simulate", "--out", str(folder / "never")]):
            code, _, err = run(*command, "--config", folder / "bad.toml")
            assert code == USAGE
            assert complaint in err or command[0] == "simulate"
    missing = (folder / "fusiond.toml").read_text().replace("SPEED_FL", "SPEED_XX")
    (folder / "bad.toml").write_text(missing)
    code, _, err = run("check", "--config", folder / "bad.toml")
    assert code == USAGE
    assert "there is no signal of WHEEL_SPEEDS 'SPEED_XX'" in err
    assert run("check", "--config", folder / "absent.toml")[0] == USAGE


def test_outputs_that_cannot_be_written(replay: Run, folder: Path, tmp_path: Path) -> None:
    for option, name in (("--csv", "t.csv"), ("--json", "s.json")):
        code, _, err = replay(option, tmp_path / "absent" / name)
        assert code == UNUSABLE
        assert "there is no folder" in err
        code, _, err = replay(option, tmp_path)
        assert code == UNUSABLE
        assert "cannot be written" in err
    truth = folder / "truth.csv"
    before = truth.read_bytes()
    code, _, err = replay("--truth", truth, "--csv", truth)
    assert code == USAGE
    assert "would be overwritten" in err
    assert truth.read_bytes() == before


def test_bad_truth(replay: Run, folder: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text((folder / "truth.csv").read_text().replace("48.", "x48.", 3))
    code, _, err = replay("--truth", bad)
    assert (code, "Traceback" in err) == (UNUSABLE, False)
    assert "bad.csv:2: lat_deg: 'x48." in err
    bad.write_bytes(b"\xff\xfe\x00")
    assert "is not UTF-8 text" in replay("--truth", bad)[2]
    zipped = tmp_path / "bad.csv.gz"
    zipped.write_bytes(gzip.compress((folder / "truth.csv").read_bytes())[:-300])
    assert "is not a valid gzip file" in replay("--truth", zipped)[2]
    assert "cannot be read" in replay("--truth", tmp_path / "absent.csv")[2]


def test_a_truth_of_another_drive_is_a_warning(replay: Run, tmp_path: Path) -> None:
    other = tmp_path / "other.csv"
    other.write_text("unix_us,lat_deg,lon_deg,height_m,vn_mps,ve_mps,yaw_deg\n1,48,11,500,0,0,0\n2,48,11,500,0,0,0\n")
    code, out, _ = replay("--truth", other)
    assert code == SUCCESS
    assert "warning: other.csv: no published state to compare with it" in out


def test_interrupt_ends_with_a_line(replay: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fusiond.app.commands.replay.replay", interrupted)
    assert replay() == (INTERRUPTED, "", "fusiond: interrupted\n")


# --- Broken logs


def damaged(data: bytes, kind: str) -> bytes:
    """A log with a certain damage; the same every time."""
    chance = random.Random(5)
    if kind == "truncated":
        return data[: len(data) * 2 // 3 + 5]
    if kind == "corrupted":
        broken = bytearray(data)
        for _ in range(len(data) // 500):
            broken[chance.randrange(len(data))] = chance.randrange(256)
        return bytes(broken)
    if kind == "garbage":
        return chance.randbytes(50_000)
    return b""


@pytest.mark.parametrize("name", ["drive.tlog", "drive.log"])
@pytest.mark.parametrize("kind", ["truncated", "corrupted"])
def test_a_damaged_log_is_used_as_far_as_it_goes(replay: Run, folder: Path, tmp_path: Path, name: str, kind: str) -> None:
    (tmp_path / name).write_bytes(damaged((folder / name).read_bytes(), kind))
    logs = [tmp_path / name, *(folder / other for other in ("drive.tlog", "drive.log") if other != name)]
    figures = tmp_path / "summary.json"
    code, _, err = replay(*logs, "--json", figures, "--csv", tmp_path / "track.csv")
    assert (code, err) == (SUCCESS, "")
    summary = msgspec.json.decode(figures.read_bytes(), type=Summary)
    assert any(source.fused for source in summary.sources.values())
    met = summary.logs[name]
    if kind == "corrupted":
        assert met.keys() & {"bad bytes", "bad lines", "bad checksum", "bad stamps"}


@pytest.mark.parametrize("name", ["drive.tlog", "drive.log", "drive.tlog.gz", "drive.log.gz"])
@pytest.mark.parametrize("kind", ["empty", "garbage"])
def test_a_file_that_is_no_log_is_refused(replay: Run, folder: Path, tmp_path: Path, name: str, kind: str) -> None:
    (tmp_path / name).write_bytes(damaged(b"", kind))
    code, _, err = replay(tmp_path / name)
    assert code == UNUSABLE
    assert str(tmp_path / name) in err
    assert "Traceback" not in err


def test_interleaved_logs(replay: Run, folder: Path, tmp_path: Path) -> None:
    tlog, candump = (folder / "drive.tlog").read_bytes(), (folder / "drive.log").read_bytes()
    mixed = b"".join(
        part
        for at in range(0, max(len(tlog), len(candump)), 4000)
        for part in (tlog[at : at + 4000], candump[at : at + 4000])
    )
    for name in ("mixed.tlog", "mixed.log"):
        (tmp_path / name).write_bytes(mixed)
        figures = tmp_path / "summary.json"
        code, _, err = replay(tmp_path / name, "--json", figures)
        assert (code, err) == (SUCCESS if name == "mixed.tlog" else NO_STATE, "")
        met = msgspec.json.decode(figures.read_bytes(), type=Summary).logs[name]
        assert met.keys() & {"bad bytes", "bad lines"}


def test_logs_swapped_or_unusable(replay: Run, folder: Path, tmp_path: Path) -> None:
    swapped = tmp_path / "swapped.tlog"
    swapped.write_bytes((folder / "drive.log").read_bytes())
    code, _, err = replay(swapped)
    assert code == UNUSABLE
    assert "no MAVLink frame in it" in err
    other = tmp_path / "other.log"
    other.write_text("(1760000000.000000) can0 123#00\n")
    code, _, err = replay(other)
    assert code == NO_STATE
    assert "nothing in the logs that the configuration asks for" in err
    assert replay(tmp_path / "absent.tlog")[0] == UNUSABLE


def test_a_process_of_its_own_ends_without_a_traceback(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "garbage.tlog").write_bytes(damaged(b"", "garbage"))
    command = [sys.executable, "-m", "fusiond", "replay", "--config", str(folder / "fusiond.toml")]
    done = subprocess.run([*command, str(tmp_path / "garbage.tlog")], capture_output=True, text=True, check=False)
    assert done.returncode == UNUSABLE
    assert done.stdout == ""
    assert done.stderr.startswith("fusiond: ")
    assert len(done.stderr.splitlines()) == 1
