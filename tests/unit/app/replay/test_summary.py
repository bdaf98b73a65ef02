"""The summary of a replay: dead reckoning, sources, and the text for a reader."""

from __future__ import annotations

import msgspec
import pytest
from msgspec.structs import replace

from fusiond.app.replay import summary as report
from fusiond.estimator.solution import Mode
from fusiond.timeline.aligner import ClockReport
from fusiond.units import SECOND
from tests.helpers.published import message


def test_dead_reckoning_begins_with_the_last_fix_and_ends_with_the_next() -> None:
    log = report.DeadReckoningLog(timeout_s=2.0)
    for tenth in range(100):
        second = tenth / 10
        mode = Mode.DEAD_RECKONING if 4.0 <= second < 7.0 else Mode.NOMINAL
        log.add(round(second * SECOND), message(second, mode, speed=10.0), None)
    found = log.report()
    (stretch,) = found.stretches
    assert (stretch.start_s, stretch.stop_s) == (2.0, 7.0)
    assert stretch.distance_m == pytest.approx(49.0)  # to the last publication in it, at 6.9 s
    assert stretch.sigma_m == pytest.approx(5.0)
    assert stretch.error_m is None
    assert (found.count, found.seconds) == (1, 5.0)


def test_dead_reckoning_that_is_open_at_the_end_is_reported() -> None:
    log = report.DeadReckoningLog(timeout_s=1.0)
    for second in range(6):
        log.add(second * SECOND, message(second, Mode.DEAD_RECKONING if second > 2 else Mode.NOMINAL), None)
    assert [(s.start_s, s.stop_s) for s in log.report().stretches] == [(2.0, 5.0)]


def test_many_stretches_are_counted_but_not_all_kept() -> None:
    log = report.DeadReckoningLog(timeout_s=0.5)
    for second in range(400):
        log.add(second * SECOND, message(second, Mode.DEAD_RECKONING if second % 2 else Mode.NOMINAL), None)
    found = log.report()
    assert found.count == 200
    assert len(found.stretches) == report.MAX_STRETCHES


def test_source_report_adds_up() -> None:
    outcomes = {"FUSED": 5, "REJECTED": 1, "TOO_OLD": 0, "DUPLICATE": 2, "INVALID": 3, "WAITING": 0, "GATHERED": 0}
    found = report.source_report(4, outcomes, {"no fix": 3}, None)
    assert (found.events, found.fused, found.withheld, found.invalid_reasons) == (15, 5, 4, {"no fix": 3})


def summary() -> report.Summary:
    outcomes = {"FUSED": 5, "REJECTED": 1, "TOO_OLD": 2, "DUPLICATE": 0, "INVALID": 3, "WAITING": 0, "GATHERED": 0}
    lateness = report.TooOld(late_s=1.3, beyond_s=0.25, clock="unix")
    source = report.source_report(0, outcomes, {"no fix": 3}, None, lateness)
    return report.Summary(
        fusiond="0",
        config="car.toml",
        vehicle="car",
        logs={"a.tlog": {"records": 1}},
        warnings=["a.tlog: odd"],
        span=report.Span(first_ns=0, last_ns=SECOND, seconds=1.0),
        events=11,
        clock_pairs=0,
        rerun=7,
        sources={"gps0.position": source},
        clocks={},
        final=message(),
    )


def test_the_text_has_what_a_reader_needs() -> None:
    text = report.text(summary())
    for part in (
        "car: 1.0 s from 1970-01-01 00:00:00 UTC out of a.tlog",
        "warning: a.tlog: odd",
        "invalid of gps0.position: no fix (3)",
        "2 came later than filter.horizon_s allows, by up to 0.25 s; a horizon longer by that would use them",
        "7 events were run again",
        "+- 3.00 m north, 4.00 m east",
    ):
        assert part in text
    assert "duplicate" not in text  # a column of nothing but zeros
    assert all(line == line.rstrip() for line in text.splitlines())


@pytest.mark.parametrize(
    ("late_s", "resets", "advice"),
    [
        (2.5, 0, "a horizon longer by that"),
        (1.8, 1, "a horizon longer by that"),
        (2.5, 1, "clock fc/1/boot had jumped, and was not re-aligned yet; no horizon helps"),
        (8.0, 0, "look for a link that stalls"),
    ],
)
def test_the_advice_on_what_came_too_late_is_that_of_its_cause(late_s: float, resets: int, advice: str) -> None:
    found = summary()
    lateness = report.TooOld(late_s=late_s, beyond_s=late_s - 1.0, clock="fc/1/boot")
    clock = ClockReport("least_offset", 0, 0.0, 0, resets, 0, 100)
    source = replace(found.sources["gps0.position"], lateness=lateness)
    text = report.text(replace(found, sources={"gps0.position": source}, clocks={"fc/1/boot": clock}))
    (line,) = (line for line in text.splitlines() if "came later than" in line)
    assert f"by up to {late_s - 1.0:.2f} s" in line and advice in line


def test_steps_back_are_listed_up_to_a_number() -> None:
    steps = [report.StepBack(at_s=10.0 * n, by_s=3600.0) for n in range(1, 9)]
    text = report.text(replace(summary(), steps_back=steps))
    assert "warning: at 10.0 s the receipt stamps step back by 3600.0 s: a new session begins there" in text
    assert text.count("step back by") == report.MAX_STEPS and "and 3 more times" in text


def test_json_reads_back() -> None:
    decoded = msgspec.json.decode(report.to_json(summary()), type=report.Summary)
    assert decoded == summary()
