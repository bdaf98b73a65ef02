"""The library: tables in, tracks out; the same as events give; and what is wrong with a table."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from fusiond.arrays import ArrayError, Track, configured, fuse
from fusiond.config.toml import ConfigError
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Measurement, WheelSpeed
from fusiond.maths.rotation import matrix_from_euler
from tests.conftest import needs_compiled
from tests.helpers.streams import MS, SECOND, T0, WHEELS, measurements, town
from tests.helpers.streams import fuse as fuse_events

TOML = """
[filter]
heading_deg = 40.0
[imu.imu0]
[gnss.gps0]
position_correlation_s = 0
velocity_correlation_s = 0
stamp_sigma_ms = 0
[wheel.front_left]
[wheel.front_right]
[wheel.rear_left]
[wheel.rear_right]
"""
TRUTH = town(14.0, rate=50.0)
EVENTS = measurements(TRUTH)


def tables(events: Iterable[Measurement]) -> dict[str, dict[str, Any]]:
    """Events as the tables that they might have come from."""
    found: dict[str, dict[str, list[float]]] = {}

    def add(name: str, event: Measurement, **values: float) -> None:
        table = found.setdefault(name, {})
        if "vn_mps" in values and table["t_ns"][-1] == event.t_ns:
            pass
        else:
            values |= {"t_ns": event.t_ns, "t_receive": (event.t_receive_ns - T0) * 1e-9 + T0 / SECOND}
        for column, value in values.items():
            table.setdefault(column, []).append(value)

    for event in events:
        payload = event.payload
        if isinstance(payload, ImuSample):
            axes = {f"accel_{a}": f for a, f in zip("xyz", payload.specific_force_b, strict=True)}
            add("imu0", event, **axes, **{f"gyro_{a}": w for a, w in zip("xyz", payload.angular_rate_b, strict=True)})
        elif isinstance(payload, GnssPosition):
            lat, lon = np.degrees([payload.latitude, payload.longitude]).tolist()
            add("gps0", event, lat_deg=lat, lon_deg=lon, height_m=payload.height, sigma_m=1.0, sigma_height_m=1.0)
        elif isinstance(payload, GnssVelocity):
            assert payload.down is not None
            add("gps0", event, vn_mps=payload.north, ve_mps=payload.east, vd_mps=payload.down, sigma_v_mps=0.1)
        elif isinstance(payload, WheelSpeed):
            add(event.source, event, speed_mps=payload.speed)
    return {name: {c: np.array(v) for c, v in table.items() if c != "t_receive"} for name, table in found.items()}


TABLES = tables(EVENTS)


def rms(track: Track) -> float:
    true = np.stack([np.interp(track.t - T0 / SECOND, TRUTH.seconds, TRUTH.velocity_n[:, k]) for k in range(3)], axis=1)
    return float(np.sqrt(((track.velocity_n - true) ** 2).sum(axis=1).mean()))


@needs_compiled
def test_a_track_is_that_of_the_events() -> None:
    at = T0 / SECOND + np.array([6.0, 8.0, 13.5])
    track = fuse(TOML, TABLES, at=at)
    assert len(track) == 3
    assert track.outcomes["imu0"]["FUSED"] > 600 and track.outcomes["gps0.position"]["REJECTED"] == 0
    fusion = fuse_events(configured(TOML), sorted((e for e in EVENTS if e.t_ns <= track.t_ns[1]), key=lambda e: e.key))
    expected = fusion.solution_at(int(track.t_ns[1])).state
    assert expected is not None
    np.testing.assert_allclose(track.velocity_n[1], expected.velocity_n, atol=1e-6)
    np.testing.assert_allclose(track.covariance[1], expected.covariance, rtol=1e-4)
    np.testing.assert_allclose(np.radians([track.lat_deg[1], track.lon_deg[1]]), [expected.latitude, expected.longitude])


@needs_compiled
def test_a_smoothed_track_is_closer_to_the_truth() -> None:
    live, smoothed = fuse(TOML, TABLES, rate_hz=10.0), fuse(TOML, TABLES, smooth=True, rate_hz=10.0)
    assert 100 < len(smoothed) <= len(live) <= 141
    common = np.isin(live.t_ns, smoothed.t_ns)
    assert rms(smoothed) < 0.8 * rms(live)
    assert (smoothed.sigmas.mean(axis=0) < live.sigmas[common].mean(axis=0)).all()
    distance = np.hypot(np.diff(smoothed.north_m), np.diff(smoothed.east_m)).sum()
    assert distance == pytest.approx(np.hypot(*smoothed.velocity_n[:, :2].T).mean() * (len(smoothed) - 1) / 10, rel=0.02)


@needs_compiled
def test_data_frames_go_in_and_out() -> None:
    pandas = pytest.importorskip("pandas")
    frames = {name: pandas.DataFrame(table) for name, table in TABLES.items()}
    for frame in frames.values():
        frame["t"] = pandas.to_datetime(frame.pop("t_ns"))
    found = fuse(TOML, frames, rate_hz=5.0).frame()
    expected = fuse(TOML, TABLES, rate_hz=5.0)
    np.testing.assert_array_equal(found["yaw_deg"].to_numpy(), expected.roll_pitch_yaw_deg[:, 2])
    np.testing.assert_array_equal(found.index.to_numpy(), expected.t)
    assert found.index.name == "t" and {"mode", "north_m", "sigma_position_n", "vd_mps", "qw"} <= set(found.columns)


@needs_compiled
def test_three_axes_may_be_one_array_and_be_turned() -> None:
    turn = matrix_from_euler(*np.radians([180.0, 0.0, 90.0]).tolist())
    accel, gyro = (np.stack([TABLES["imu0"][f"{kind}_{a}"] for a in "xyz"], axis=1) for kind in ("accel", "gyro"))
    turned = {"t_ns": TABLES["imu0"]["t_ns"], "accel": accel @ turn, "gyro": gyro @ turn}
    mounted = TOML.replace("[imu.imu0]", "[imu.imu0]\nrotation_deg = [180.0, 0.0, 90.0]")
    one, other = fuse(mounted, TABLES | {"imu0": turned}, rate_hz=1.0), fuse(TOML, TABLES, rate_hz=1.0)
    np.testing.assert_allclose(one.velocity_n, other.velocity_n, atol=1e-6)


@needs_compiled
def test_what_is_no_number_is_left_out_and_late_is_late() -> None:
    gps = {name: values.copy() for name, values in TABLES["gps0"].items()}
    gps["vn_mps"][::2] = np.nan
    gps["t_receive"] = gps["t_ns"] / SECOND + 0.2
    imu = {name: values.copy() for name, values in TABLES["imu0"].items()}
    imu["accel_x"][100] = np.nan
    track = fuse(TOML, TABLES | {"gps0": gps, "imu0": imu}, rate_hz=1.0)
    assert track.outcomes["imu0"]["INVALID"] == 1
    fused = {name: counts["FUSED"] + counts["GATHERED"] for name, counts in track.outcomes.items()}
    assert fused["gps0.velocity"] == pytest.approx(fused["gps0.position"] / 2, abs=2)
    assert np.isfinite(track.covariance).all()


def test_a_drive_without_a_state_gives_an_empty_track() -> None:
    track = fuse(TOML, {"imu0": {name: values[:20] for name, values in TABLES["imu0"].items()}})
    assert len(track) == 0 and track.covariance.shape == (0, 9, 9) and track.velocity_n.shape == (0, 3)


def test_a_configuration_of_a_text() -> None:
    config = configured(TOML)
    assert configured(config) is config
    assert config.wheel["rear_left"].link and set(config.wheel) == set(WHEELS)


IMU = TABLES["imu0"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"gps0": TABLES["gps0"]}, "imu0: the table of the inertial sensor is missing"),
        ({"imu0": IMU, "gps1": {}}, "gps1: no such sensor is configured; there are imu0, gps0, "),
        ({"imu0": {"t_ns": IMU["t_ns"]}}, "imu0: no column accel_x, accel_y, accel_z, gyro_x"),
        ({"imu0": {k: v for k, v in IMU.items() if k != "t_ns"}}, "imu0: no column t or t_ns"),
        ({"imu0": IMU | {"gyro_x": np.zeros(3)}}, r"imu0: columns of one length are needed: .*gyro_x \(3,\)"),
        ({"imu0": IMU | {"t_ns": IMU["t_ns"] * 1.0}}, "imu0: t_ns: whole nanoseconds are needed, not float64"),
        ({"imu0": {**{k: v for k, v in IMU.items() if k != "t_ns"}, "t": IMU["t_ns"]}}, "nanoseconds go into a column t_ns"),
        ({"imu0": IMU | {"accel_x": np.array(["a"] * len(IMU["t_ns"]))}}, "imu: accel_x: not numbers"),
        ({"imu0": [1.0, 2.0]}, "imu0: a mapping of names to arrays, or a data frame, is needed, not list"),
    ],
)
def test_what_is_wrong_with_a_table(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ArrayError, match=said):
        fuse(TOML, given)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[imu.imu0]\ngyro_nose = 1\n", "gyro_nose: unknown key .did you mean 'gyro_noise'"),
        ("[imu.imu0]\n[imu\n", "not valid TOML"),
        ("[filter]\nhorizon_s = 2.0\n", "imu"),
        ("[imu.imu0]\n[filter]\nhorizon_s = 0.1\n", "filter.imu_gap_s: must be below horizon_s"),
    ],
)
def test_what_is_wrong_with_a_configuration(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        configured(text)


def test_the_example_of_the_documentation_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its ten lines, on this drive."""
    from tests.helpers.paths import ROOT  # noqa: PLC0415

    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "arrays.md").read_text(), re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    names: dict[str, Any] = {"imu": TABLES["imu0"], "fixes": TABLES["gps0"], "wheel": TABLES["rear_left"]}
    pytest.importorskip("pandas")
    exec(compile(code, "arrays.md", "exec"), names)
    assert len(names["track"]) > 100 and T0 + 14 * SECOND >= names["track"].t_ns[-1] > T0 + 13 * SECOND + 900 * MS
