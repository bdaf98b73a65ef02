"""The smoother over archived drives: of both kernels, at any instants, with runs that end and begin, and readings that only
the future unmasks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
import pytest

from fusiond.config.schema import Config
from fusiond.estimator.archive import Archive, Spool
from fusiond.estimator.fusion import Fusion
from fusiond.estimator.smoother import Judged, Smoother
from fusiond.estimator.solution import Mode, Solution
from fusiond.events import GnssPosition, Measurement
from fusiond.filter.rows import Outcome
from fusiond.filter.smoothing import LEFT, USED
from fusiond.maths.wgs84 import ecef, mat_ne
from tests.conftest import needs_compiled
from tests.helpers.streams import SECOND, T0, Drive, bits, config, measurements, town

GIVEN = {"heading_deg": 40.0}
TOWN = town(12.0, rate=50.0)
EVENTS = measurements(TOWN)
LONG = town(40.0, rate=50.0)


def archived(events: Iterable[Measurement], settings: Config, compiled: bool | None = None) -> tuple[Archive, Fusion]:
    """The archive of a drive, and the fusion after it."""
    fusion = Fusion(settings, compiled)
    archive = Archive(fusion.params, Spool.in_memory())
    fusion.history.archive = archive.add
    for event in events:
        fusion.fuse(event)
    fusion.history.finish()
    archive.finish()
    return archive, fusion


def instants(begin: float, end: float, step: float = 0.1) -> np.ndarray:
    return T0 + np.round(np.arange(begin, end, step) * SECOND).astype(np.int64)


def smoothed(archive: Archive, times: np.ndarray, compiled: bool | None = None) -> list[Solution]:
    smoother = Smoother(archive, times, compiled=compiled)
    smoother.smooth()
    return list(smoother.solutions())


def place(solution: Solution) -> np.ndarray:
    assert solution.state is not None
    return ecef(solution.state.latitude, solution.state.longitude, solution.state.height)


def errors(solutions: Sequence[Solution], truth: Drive) -> np.ndarray:
    """Horizontal errors [m]."""
    found = []
    for solution in solutions:
        true = np.array([np.interp((solution.t_ns - T0) / SECOND, truth.seconds, truth.position_e[:, i]) for i in range(3)])
        off = mat_ne(true) @ (place(solution) - true)
        found.append(math.hypot(off[0], off[1]))
    return np.array(found)


def without(events: list[Measurement], begin: float, end: float) -> list[Measurement]:
    """The events without GNSS from a second to another."""
    hidden = T0 + int(begin * SECOND), T0 + int(end * SECOND)
    return [e for e in events if not (e.source.startswith("gps0") and hidden[0] <= e.t_ns < hidden[1])]


@needs_compiled
@pytest.mark.parametrize("wide", [False, True])
def test_both_kernels_give_the_same_bits(wide: bool) -> None:
    delays = {"gnss": {"delay_sigma_ms": 20.0}, "imu": {"delay_sigma_ms": 5.0}} if wide else {}
    settings = config(filter=GIVEN, **delays)
    events = [event for event in EVENTS if event.t_ns < T0 + 8 * SECOND]
    found = []
    for compiled in (True, False):
        solutions = smoothed(archived(events, settings, compiled)[0], instants(5.0, 7.0, 0.37), compiled)
        assert len(solutions) == 6
        found.append(np.array([[*place(s), *s.state.covariance.ravel()] for s in solutions if s.state]))
    np.testing.assert_array_equal(bits(found[0]), bits(found[1]))


@needs_compiled
def test_the_last_state_is_the_filters() -> None:
    """Nothing comes after it, so there is nothing to smooth, where the same measurements were used."""
    archive, fusion = archived(EVENTS, config(filter=GIVEN))
    last = fusion.history.applied_ns
    (solution,) = smoothed(archive, np.array([last]))
    expected = fusion.solution_at(last)
    assert solution.t_ns == expected.t_ns and solution.mode is Mode.NOMINAL
    assert solution.state is not None and expected.state is not None
    np.testing.assert_allclose(place(solution), place(expected), atol=0.02)
    np.testing.assert_allclose(np.diag(solution.state.covariance), np.diag(expected.state.covariance), rtol=0.05)


@needs_compiled
def test_looks_do_not_change_the_track() -> None:
    archive, _ = archived(EVENTS, config(filter=GIVEN))
    few, many = smoothed(archive, instants(5.0, 11.0, 1.0)), smoothed(archive, instants(5.0, 11.0, 0.05))
    at = {s.t_ns: s for s in many}
    assert len(few) == 6 and len(many) == 120
    for solution in few:
        np.testing.assert_allclose(place(solution), place(at[solution.t_ns]), atol=1e-4)


@needs_compiled
def test_an_outage_is_bridged_from_both_sides() -> None:
    events = without(measurements(LONG), 15.0, 30.0)
    archive, _ = archived(events, config(filter=GIVEN))
    times = instants(15.0, 30.0, 0.5)
    solutions = smoothed(archive, times)
    assert [s.t_ns for s in solutions] == times.tolist()
    fusion, filtered = Fusion(config(filter=GIVEN)), []
    wanted = iter(times.tolist())
    due = next(wanted)
    for event in events:
        fusion.fuse(event)
        while due is not None and fusion.history.applied_ns >= due:
            filtered.append(fusion.solution_at(due))
            due = next(wanted, None)
    off, live = errors(solutions, LONG), errors(filtered, LONG)
    assert float(np.sqrt((off**2).mean())) < float(np.sqrt((live**2).mean()))
    for one, other in zip(solutions, filtered, strict=True):
        assert one.state is not None and other.state is not None
        assert np.all(np.diag(one.state.covariance) <= np.diag(other.state.covariance) * 1.01)
    sigmas = [math.hypot(*s.state.sigma_position_n()[:2]) for s in solutions if s.state]
    assert sigmas[0] < max(sigmas) > sigmas[-1]


@needs_compiled
def test_an_outlier_is_unmasked_by_the_future() -> None:
    """After an outage the filter knows its place so badly that it believes a fix that is 5 sigma off. The fixes after it say
    what it was."""
    noisy = {"gyro_noise": 0.01, "accel_noise": 0.5}
    settings = config((), filter=GIVEN, motion={"lateral_sigma_mps": 2.0}, imu=noisy)
    events = without(measurements(LONG, wheels=()), 12.0, 32.0)
    first = next(i for i, e in enumerate(events) if e.source == "gps0.position" and e.t_ns >= T0 + 32 * SECOND)
    fix = events[first].payload
    assert isinstance(fix, GnssPosition)
    wrong = msgspec.structs.replace(fix, latitude=fix.latitude + 8.0 / 6.37e6)
    events[first] = msgspec.structs.replace(events[first], payload=wrong)
    archive, fusion = archived(events, settings)
    source = fusion.params.sources.index("gps0.position")
    found: list[tuple[int, int, int]] = []

    def judge(judged: Judged) -> None:
        for row, verdict in zip(judged.rows, judged.verdicts, strict=True):
            if row["source"] == source:
                found.append((int(row["t_ns"]), int(row["outcome"]), int(verdict[0])))

    Smoother(archive, instants(0, 0)).smooth(judge)
    (bad,) = [one for one in found if one[0] == events[first].t_ns]
    assert bad[1:] == (Outcome.FUSED, LEFT)
    rest = [verdict for t_ns, _, verdict in found if t_ns != events[first].t_ns]
    assert len(rest) > 50 and rest.count(USED) > 0.95 * len(rest)


@needs_compiled
def test_a_new_session_is_a_run_of_its_own() -> None:
    """Time steps back, and the drive begins again."""
    fusion = Fusion(config(filter=GIVEN))
    archive = Archive(fusion.params, Spool.in_memory())
    fusion.history.archive = archive.add
    for session in range(2):
        if session:
            fusion.begin_session()
        for event in EVENTS:
            fusion.fuse(event)
    fusion.history.finish()
    archive.finish()
    assert len(archive.runs) == 2
    assert archive.runs[0].end_ns == archive.runs[1].end_ns
    solutions = smoothed(archive, instants(8.0, 10.0, 0.5))
    assert [s.t_ns for s in solutions] == 2 * instants(8.0, 10.0, 0.5).tolist()


def test_a_drive_without_a_state_has_no_runs() -> None:
    archive, _ = archived([event for event in EVENTS if event.source == "imu0"], config())
    assert archive.runs == []
    assert smoothed(archive, instants(0.0, 10.0)) == []


@needs_compiled
def test_a_gap_in_the_data_ends_a_run() -> None:
    by = 100 * SECOND
    later = [
        msgspec.structs.replace(e, t_ns=e.t_ns + by, t_receive_ns=e.t_receive_ns + by, sequence=e.sequence + 10**6)
        for e in EVENTS
    ]
    archive, _ = archived([*EVENTS, *later], config(filter=GIVEN))
    assert len(archive.runs) == 2
    solutions = smoothed(archive, np.sort(np.concatenate([instants(8.0, 10.0, 0.5), instants(108.0, 110.0, 0.5)])))
    assert len(solutions) == 8 and all(s.mode is Mode.NOMINAL for s in solutions)
