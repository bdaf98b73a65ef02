"""The barometer: the standard atmosphere, its offset as a state, both kernels alike, and late readings."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fusiond.config.load import load, parse
from fusiond.config.schema import Barometer, Config
from fusiond.config.toml import ConfigError
from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, Measurement, Pressure
from fusiond.filter.calibration import calibrations
from fusiond.filter.kernel.interpreted import compiled_available
from fusiond.filter.observations import barometric_height
from fusiond.filter.observations.model import PARAMETERS, Unusable
from fusiond.filter.rows import Outcome
from fusiond.filter.state import (
    CALIBRATIONS,
    CHOOSING,
    HEIGHT_OFFSET,
    HEIGHT_OFFSET_ERROR,
    PHASE,
    POSITION_E,
    RESETS,
    RUNNING,
    WIDE_SIZE,
    FilterState,
)
from fusiond.maths.wgs84 import ecef
from fusiond.simulation.scenario import parse as parse_scenario
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.write import write_drive
from tests.conftest import needs_compiled
from tests.helpers.observations import observed
from tests.helpers.streams import MS, MUNICH, SECOND, T0, bits, config, fuse, measurements, same_bits, town

OFFSET = 45.0  # m, of the readings below
DRIVE = town(30.0)
HILL = """
[barometer]
rate_hz = 10
offset_m = 80.0
[start]
speed_mps = 12.0
[[segment]]
duration_s = 12
grade_deg = 6.0
[[segment]]
duration_s = 13
grade_deg = -4.0
"""


def settings(**tables: dict[str, object]) -> Config:
    return config(("rear_left", "rear_right"), **{"barometer": {"baro": {"link": "link", "sigma_m": 0.5}}} | tables)


def pressure(altitude: float) -> float:
    """The standard pressure [Pa] at a geopotential height [m] of the troposphere."""
    return 101_325.0 * float((1 - 0.0065 * altitude / 288.15) ** (9.80665 / (287.05287 * 0.0065)))


def readings(offset: float = OFFSET, first: float = 0.0, last: float = 30.0, seed: int = 5) -> list[Measurement]:
    """What a barometer at 10 Hz says of a drive at one height, with a white noise of 0.5 m."""
    rng = np.random.default_rng(seed)
    stamps = T0 + 7 * MS + np.arange(round(first * 10), round(last * 10)) * 100 * MS
    altitudes = MUNICH[2] + offset + 0.5 * rng.standard_normal(len(stamps))
    return [
        Measurement(t_ns, "baro", i, t_ns + 5 * MS, Pressure(pressure(altitude), 290.0))
        for i, (t_ns, altitude) in enumerate(zip(stamps.tolist(), altitudes.tolist(), strict=True))
    ]


def ordered(events: list[Measurement]) -> list[Measurement]:
    return sorted(events, key=lambda event: (event.t_receive_ns, event.key))


def offset_of(fusion: Fusion) -> tuple[float, float]:
    """The height offset and its sigma [m]."""
    return calibrations(fusion.params, fusion.history.head)["height_offset_m"]


def taken(fusion: Fusion, source: str) -> int:
    """Readings that went into the state, or into the hypotheses before there was one."""
    counts = fusion.outcomes()[source]
    return counts[Outcome.FUSED.name] + counts[Outcome.GATHERED.name]


def test_values_and_parameters() -> None:
    barometer = Barometer(link="l", sigma_m=2.0, correlation_s=3.0)
    altitude, variance = barometric_height.values(Pressure(pressure(1_000.0), 250.0), barometer)
    assert (altitude, variance) == (pytest.approx(1_000.157, abs=2e-3), 4.0)  # geometric
    assert barometric_height.parameters(barometer).shape == (PARAMETERS,)
    for wrong, reason in ((999.0, "impossible"), (120_001.0, "impossible"), (math.nan, "not finite")):
        with pytest.raises(Unusable, match=reason):
            barometric_height.values(Pressure(wrong, 290.0), barometer)


def test_a_reading_is_height_and_offset() -> None:
    state = FilterState(1, WIDE_SIZE)
    state.nominal[POSITION_E] = ecef(*MUNICH)
    state.nominal[HEIGHT_OFFSET] = -3.0
    row = np.array([MUNICH[2] + 2.0, 0.25])
    seen = observed(barometric_height.observe, state, row, barometric_height.parameters(Barometer(link="l")))
    assert seen is not None
    np.testing.assert_allclose(seen.innovation, [5.0], atol=1e-8)
    assert (seen.jacobian[0, HEIGHT_OFFSET_ERROR], seen.variance.tolist()) == ([1.0], [0.25])


def test_sources_and_what_may_not_stand_together() -> None:
    assert settings().sources() == ("baro", "gps0.position", "gps0.velocity", "imu0", "rear_left", "rear_right")
    text = '[mavlink.fc]\n[imu.imu0]\nlink = "fc"\n[gnss.gps0]\nlink = "fc"\n[barometer.a]\nlink = "fc"\n'
    assert parse(text).barometer["a"].offset_sigma_m == 100.0
    with pytest.raises(ConfigError, match=r"one height offset to learn, that of \[barometer.a\]"):
        parse(text + '[barometer.b]\nlink = "fc"\n')
    with pytest.raises(ConfigError, match="noise_least"):
        parse(text + "noise_least = 4.0\n")


def test_the_offset_is_learnt_and_steadies_the_height() -> None:
    """Over half a minute of fixes that scatter by 3 m in height."""
    rng = np.random.default_rng(9)
    events = []
    for event in measurements(DRIVE, ("rear_left", "rear_right")):
        payload = event.payload
        if isinstance(payload, GnssPosition):
            height = MUNICH[2] + 3.0 * rng.standard_normal()
            payload = GnssPosition(payload.latitude, payload.longitude, height, 1.0, 3.0)
        events.append(Measurement(event.t_ns, event.source, event.sequence, event.t_receive_ns, payload))
    fusion = fuse(settings(), ordered(events + readings()))
    offset, sigma = offset_of(fusion)
    assert sigma < 1.0
    assert abs(offset - OFFSET) < 3 * sigma
    state = fusion.solution_at(fusion.history.applied_ns).state
    assert state is not None
    assert abs(state.height - MUNICH[2]) < 3 * math.sqrt(state.covariance[2, 2])
    assert taken(fusion, "baro") >= 298


def test_a_simulated_drive(tmp_path: Path) -> None:
    """Over a hill, from logs to the offset; the readings are written and decoded as any autopilot's."""
    write_drive(parse_scenario(HILL), tmp_path)
    loaded = load(tmp_path / "fusiond.toml")
    fusion = Fusion(loaded)
    for received in open_logs([tmp_path / "drive.tlog", tmp_path / "drive.log"], loaded):
        fusion.feed(received)
    offset, sigma = offset_of(fusion)
    assert sigma < 2.0
    assert abs(offset - 80.0) < 3 * sigma
    assert taken(fusion, "baro0") >= 0.99 * sum(fusion.outcomes()["baro0"].values()) > 240


def test_an_offset_that_jumps_is_learnt_anew() -> None:
    """By a window that is opened at speed, say: rejected, believed once it is called biased, and no jump of the state."""
    chosen = settings()
    events = measurements(DRIVE, ("rear_left", "rear_right"))
    fusion = fuse(chosen, ordered(events + readings(last=15.0) + readings(OFFSET + 60.0, 15.0, seed=6)))
    offset, sigma = offset_of(fusion)
    assert abs(offset - OFFSET - 60.0) < 3 * sigma + 0.5
    assert 20 <= fusion.outcomes()["baro"]["REJECTED"] <= 70
    assert fusion.history.head.stamps[RESETS] == 0
    state = fusion.solution_at(fusion.history.applied_ns).state
    assert state is not None
    assert abs(state.height - MUNICH[2]) < 1.0
    assert np.linalg.eigvalsh(fusion.history.head.covariance).min() > -1e-9


@needs_compiled
def test_both_kernels_alike() -> None:
    """Through alignment, the choice of a heading with the barometer's readings in it, and the run after it."""
    events = ordered(measurements(town(9.0, rate=25.0), ("rear_left", "rear_right"), wheel_hz=10.0) + readings(last=9.0))
    chosen, met = settings(filter={"course_speed_mps": 50.0}), set()
    first, second = Fusion(chosen, True), Fusion(chosen, False)
    for event in events:
        first.fuse(event)
        second.fuse(event)
        if event.source == "baro":
            met.add(int(first.history.head.stamps[PHASE]))
    assert met >= {CHOOSING, RUNNING}
    a, b = first.history.head, second.history.head
    np.testing.assert_array_equal(bits(a.numbers), bits(b.numbers))
    np.testing.assert_array_equal(a.whole, b.whole)
    assert first.outcomes() == second.outcomes()
    assert taken(first, "baro") > 80 and first.outcomes()["baro"][Outcome.FUSED.name] > 40


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=needs_compiled), False])
def test_shuffled_arrivals_give_the_same_bits(compiled: bool) -> None:
    """Late by up to half a second, readings of the barometer among them."""
    seconds, chosen = (8.0, settings()) if compiled else (4.0, settings(filter={"heading_deg": 40.0}))
    events = ordered(measurements(town(seconds, rate=25.0), ("rear_left", "rear_right")) + readings(last=seconds))
    plain = fuse(chosen, events, compiled)
    late = np.random.default_rng(11).uniform(0.0, 0.5 * SECOND, len(events))
    shuffled = [events[i] for i in np.argsort([event.t_ns + d for event, d in zip(events, late, strict=True)])]
    fusion = Fusion(chosen, compiled)
    for number, event in enumerate(shuffled):
        fusion.fuse(event)
        if number % 8 == 0:
            fusion.outcomes()  # looked at, so that later events rewind
    same_bits(fusion, plain)
    assert fusion.history.rerun > 2 * len(events)
    assert fusion.history.head.stamps[PHASE] == RUNNING


def test_a_barometer_widens_the_state() -> None:
    fusion = Fusion(settings(), compiled_available())
    assert fusion.params.size == WIDE_SIZE
    assert fusion.params.calibration_variances[HEIGHT_OFFSET_ERROR.start - CALIBRATIONS] == 100.0 * 100.0
