"""Inspections: of the bundled drive, of logs whose sensors are on a CAN bus, and of captured ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusiond import __main__ as command
from fusiond.app.inspection.facts import Inspection
from fusiond.app.inspection.job import inspect
from fusiond.app.replay.job import Options, replay
from fusiond.config import load as config
from tests.helpers.paths import ROOT

DEMO = ROOT / "fusiond" / "app" / "demo" / "data"
DATA = ROOT.parent / "shared" / "data"
captured = pytest.mark.skipif(not DATA.is_dir(), reason="the captured traces are not beside the project")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Inspection, Path]:
    folder = tmp_path_factory.mktemp("demo")
    return inspect([str(DEMO / "drive.tlog.gz"), str(DEMO / "drive.log.gz")], [], folder), folder


def test_streams_of_the_bundled_drive(demo: tuple[Inspection, Path]) -> None:
    mavlink, can = demo[0].logs
    rates = {stream.name: stream.rate_hz for stream in mavlink.streams}
    assert rates["HIGHRES_IMU"] == pytest.approx(100, rel=0.02)
    assert rates["HEARTBEAT"] == pytest.approx(1, rel=0.02)
    assert (mavlink.sessions, can.format) == (1, "candump -L")
    assert list(mavlink.senders) == ["system 1, component 1"]
    assert all(stream.name.startswith("0x") for stream in can.streams)


def test_sources_of_the_bundled_drive(demo: tuple[Inspection, Path]) -> None:
    sources = {source.name: source for source in demo[0].sources}
    assert {"imu0", "gps0.position", "gps0.velocity", "rear_left", "front_right"} <= set(sources)
    assert sources["gps0.position"].late_ms > 50
    assert sources["imu0"].about["mean_force_mps2"] == pytest.approx(9.81, rel=0.02)


def test_the_configuration_is_a_start(demo: tuple[Inspection, Path]) -> None:
    """The bundled drive is fused with it: its track is nominal, and few of its measurements are rejected."""
    found, folder = demo
    assert found.config is not None
    (folder / "car.toml").write_text(found.config)
    loaded = config.load(folder / "car.toml")
    assert loaded.imu["imu0"].rotation_deg != (0.0, 0.0, 0.0)  # found from the drive
    summary = replay(Options(loaded, "car.toml", [str(DEMO / "drive.tlog.gz"), str(DEMO / "drive.log.gz")]))
    assert summary.final.mode.value == "nominal"
    for name, source in summary.sources.items():
        most = 0.15 if name.startswith("gps0") else 0.05  # a jump of 20 m is in it
        assert source.rejected < most * source.events, name


def test_a_log_without_an_inertial_sensor_gives_no_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "drive.log"
    log.write_text("".join(f"({1_700_000_000 + n}.000000) can0 123#{n:02X}00\n" for n in range(30)))
    target = tmp_path / "car.toml"
    assert command.main(["inspect", str(log), "--write-config", str(target)]) == command.USAGE
    told = capsys.readouterr()
    assert "0x123" in told.out and "note: no inertial sensor" in told.out
    assert "is not written: no inertial sensor that fusiond reads is in the logs" in told.err
    assert not target.exists()


@captured
def test_a_captured_car_is_known_by_its_wheels(tmp_path: Path) -> None:
    drive = DATA / "comma2k19-rav4"
    found = inspect([str(drive / "drive.tlog"), str(drive / "drive.candump.log")], [], tmp_path)
    best = found.wheels[0]
    assert (best.preset, best.name.split(", ")[0]) == ("toyota", "0x0AA")
    assert best.correlation is not None and best.correlation > 0.99
    assert best.factor == pytest.approx(1.0085, abs=0.003)  # the wheels read 0.85 % short
    others = {one.name for one in found.wheels if not one.preset}
    assert "0x0B4" in others  # the speed on the dashboard
    assert [Path(path).name for path in found.copied] == ["toyota.dbc"]


@captured
def test_a_captured_car_with_all_on_one_bus(tmp_path: Path) -> None:
    pytest.importorskip("asammdf")
    found = inspect([str(DATA / "canedge-car" / "00000005-60FEB5A8.MF4")], [], tmp_path)
    counts = {source.name: source.count for source in found.sources}
    assert counts["imu0"] > 4000 and counts["gps0.position"] > 35 and counts["speed"] > 80
    assert found.config is not None and "fix_types = [0, 0, 2, 3, 3, 0]" in found.config
    assert any(one.preset == "obd" for one in found.wheels)


@captured
@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("px4-sample.ulg", "no receiver is in the logs"),
        ("copter-20211208-151342.tlog", "the inertial sensor gives a sample every 1.00 s"),
        ("copter-log171.bin", ""),
    ],
)
def test_captured_flights_are_opened_or_refused_with_the_reason(tmp_path: Path, name: str, note: str) -> None:
    if name.endswith(".ulg"):
        pytest.importorskip("pyulog")
    found = inspect([str(DATA / "flight-logs" / name)], [], tmp_path)
    assert found.sources
    assert any(one.startswith(note) for one in found.notes)
