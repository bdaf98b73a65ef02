"""Replay: the instants and messages of ticks, withheld sources, and the counts of the summary."""

from __future__ import annotations

import statistics
from itertools import pairwise
from pathlib import Path

import pytest
from msgspec.structs import replace

from fusiond.app.replay.comparison import Errors, Window
from fusiond.app.replay.intervals import Withheld, parse_withheld
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.app.replay.truth import Truth, TruthSample
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.estimator.fusion import Fusion, Receipt
from fusiond.events import GnssPosition, ImuSample, Invalid, Received, WheelSpeed
from fusiond.messages import Message, OutcomeCounts, StateMessage, csv_row, state_message
from fusiond.simulation.scenario import parse
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.write import write_drive

MS = 1_000_000  # ns
SECOND = 1000 * MS
T0 = 1_700_000_000 * SECOND + 123_456_789
RATE = 30.0  # Hz: its period is no whole number of nanoseconds
DRIVE = """
[[segment]]
duration_s = 6
[start]
speed_mps = 9.0
[gnss]
delay_ms = 120.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short simulated drive."""
    path = tmp_path_factory.mktemp("drive")
    write_drive(parse(DRIVE), path)
    return path


@pytest.fixture(scope="module")
def setup(folder: Path) -> Config:
    return config.load(folder / "fusiond.toml")


@pytest.fixture(scope="module")
def events(folder: Path, setup: Config) -> list[Received]:
    return list(open_logs([folder / "drive.tlog", folder / "drive.log"], setup))


def imu(t_ns: int, sequence: int = 0) -> Received:
    return Received("imu0", sequence, "", None, t_ns, ImuSample((0.0, 0.0, -9.8), (0.0, 0.0, 0.0)))


def ticks_of(setup: Config, events: list[Received], rate_hz: float = RATE) -> tuple[Replay, list[int]]:
    """Replay, and the instants of its ticks from the first event."""
    instants: list[int] = []

    def note(message: StateMessage, _: Errors | None) -> None:
        instants.append(message.t_ns - events[0].t_receive_ns)

    replay = Replay(setup, ReplayTask(rate_hz, on_tick=[note]))
    replay.run(events)
    return replay, instants


# --- Ticks


def test_ticks_stand_on_an_exact_grid_from_the_first_receipt(setup: Config, events: list[Received]) -> None:
    _, instants = ticks_of(setup, events)
    span = events[-1].t_receive_ns - events[0].t_receive_ns
    assert instants == [k * SECOND // 30 for k in range(len(instants))]
    assert instants[-1] <= span < len(instants) * SECOND // 30


def test_a_tick_comes_after_all_it_may_know_and_before_the_rest(setup: Config, events: list[Received]) -> None:
    order: list[tuple[str, int]] = []

    def tick(message: StateMessage, _: Errors | None) -> None:
        order.append(("tick", message.t_ns))

    def receipt(receipt: Receipt) -> None:
        order.append(("event", receipt.measurement.t_receive_ns))

    Replay(setup, ReplayTask(RATE, on_tick=[tick], on_receipt=[receipt])).run(events)
    assert {kind for kind, _ in order} == {"tick", "event"}
    for (kind, t_ns), (next_kind, next_ns) in pairwise(order):
        if kind == "tick":
            assert next_ns > t_ns, "an event received by the tick came after it"
        elif next_kind == "tick":
            assert t_ns <= next_ns


def test_an_event_received_at_the_very_tick_is_in_it(setup: Config) -> None:
    _, instants = ticks_of(setup, [imu(T0), imu(T0 + 100 * MS, 1)], rate_hz=10.0)
    assert instants == [0, 100 * MS]


def test_a_tick_waits_for_an_inertial_sample_for_half_a_period(setup: Config) -> None:
    """With `on_imu`, at 10 Hz. The tick at 0 takes the sample there; that at 100 ms the one at 130, not the fix before it;
    that at 200 ms none, for the one at 260 comes too late; that at 300 ms the one at 300, that at 400 ms the one at 449."""
    waiting = replace(setup, publish=replace(setup.publish, on_imu=True))
    fix = Received("gps0.position", 0, "", None, T0 + 110 * MS, GnssPosition(0.8, 0.2, 500.0))
    samples = [imu(T0 + t * MS, k) for k, t in enumerate((0, 90, 130, 140, 260, 300, 449, 460))]
    events = sorted([*samples, fix], key=lambda event: event.t_receive_ns)
    _, instants = ticks_of(waiting, events, rate_hz=10.0)
    assert [t / MS for t in instants] == [0, 130, 250, 300, 449]


def test_another_sensor_does_not_end_the_wait(setup: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = replace(setup, publish=replace(setup.publish, on_imu=True))
    other = Received("imu1", 0, "", None, T0 + 110 * MS, ImuSample((0.0, 0.0, -9.8), (0.0, 0.0, 0.0)))
    order: list[tuple[int, int]] = []

    def note(message: Message) -> None:
        assert isinstance(message, StateMessage)
        order.append((message.t_ns - T0, engine.now_ns - T0))

    engine = Engine(waiting, note, rate_hz=10.0, only_states=True)
    known = engine.fusion.feed(imu(T0))
    monkeypatch.setattr(engine.fusion, "feed", lambda _: known)  # the other is not of this configuration
    for event in (imu(T0), other, imu(T0 + 120 * MS, 1)):
        engine.feed(event)
    assert order == [(0, 0), (120 * MS, 120 * MS)]


def test_a_tick_that_waited_has_the_state_at_its_sample(setup: Config, events: list[Received]) -> None:
    """Which is no older than the simulated transport takes; without waiting it is up to 10 ms older."""
    waiting, ages = replace(setup, publish=replace(setup.publish, on_imu=True)), {}
    for settings in (setup, waiting):
        found: list[float] = []

        def tick(message: StateMessage, _: Errors | None, found: list[float] = found) -> None:
            found.append(message.age_ms or 0.0)

        Replay(settings, ReplayTask(RATE, on_tick=[tick])).run(events)
        ages[settings.publish.on_imu] = found[:-4]  # at the end there are only late fixes
    assert max(ages[True]) < 2.5 < statistics.median(ages[False])


def test_ticks_have_the_state_of_a_live_fusion(setup: Config, events: list[Received]) -> None:
    published: dict[int, str] = {}

    def tick(message: StateMessage, _: Errors | None) -> None:
        published[message.t_ns] = csv_row(message)

    Replay(setup, ReplayTask(RATE, on_tick=[tick])).run(events)
    checked = list(published)[1::40]
    live = Fusion(setup)
    waiting = iter(events)
    event = next(waiting)
    for t_ns in checked:
        while event.t_receive_ns <= t_ns:
            live.feed(event)
            event = next(waiting)
        outcomes = OutcomeCounts(**{name.lower(): count for name, count in live.totals().items()})
        assert published[t_ns] == csv_row(state_message(live.solution_at(t_ns), setup.vehicle.name, outcomes))
    assert published[checked[-1]].endswith("nominal")


def test_a_receipt_that_runs_back_does_not_turn_time_back(setup: Config) -> None:
    stamps = [0, 50 * MS, 20 * MS, 120 * MS]
    replay, instants = ticks_of(setup, [imu(T0 + t, k) for k, t in enumerate(stamps)], rate_hz=20.0)
    assert instants == [0, 50 * MS, 100 * MS]
    assert replay.events == 4


def test_ticks_stop_in_a_gap_and_continue_on_the_grid(setup: Config) -> None:
    hole = 2 * 3600 * SECOND + 7 * MS
    replay, instants = ticks_of(setup, [imu(T0), imu(T0 + hole, 1), imu(T0 + hole + SECOND, 2)], rate_hz=10.0)
    before = [t for t in instants if t < hole]
    after = [t for t in instants if t > hole]
    assert before[-1] == 60 * SECOND - 100 * MS
    assert after[0] == 2 * 3600 * SECOND + 100 * MS
    assert len(after) == 10
    summary = replay.summary("c.toml", {}, [])
    assert summary.published is not None
    assert summary.published.rows == len(instants)
    assert summary.published.rows + summary.published.skipped == 10 * 2 * 3600 + 11


def test_without_a_sink_there_are_no_ticks(setup: Config, events: list[Received]) -> None:
    replay = Replay(setup, ReplayTask(RATE))
    replay.run(events)
    summary = replay.summary("c.toml", {}, [])
    assert summary.published is None
    assert summary.dead_reckoning is None
    assert summary.final.state is not None


def test_pace_is_called_before_every_event_and_tick(setup: Config) -> None:
    asked: list[int] = []
    replay = Replay(setup, ReplayTask(10.0, pace=asked.append, on_tick=[lambda *_: None]))
    replay.run([imu(T0), imu(T0 + 250 * MS, 1)])
    assert asked == [0, 0, 100 * MS, 200 * MS, 250 * MS]


# --- Withholding


def test_withheld_events_never_arrive_but_are_counted(setup: Config, events: list[Received]) -> None:
    out = parse_withheld("gps0:2-4", setup)
    assert out == Withheld(frozenset({"gps0.position", "gps0.velocity"}), 2 * SECOND, 4 * SECOND)
    seen: list[Receipt] = []
    replay = Replay(setup, ReplayTask(RATE, [out], on_receipt=[seen.append]))
    replay.run(events)
    first = events[0].t_receive_ns
    fixes = [event for event in events if event.source == "gps0.position"]
    kept = [e for e in fixes if not 2 * SECOND <= e.t_receive_ns - first < 4 * SECOND]
    arrived = [r.measurement.t_receive_ns for r in seen if r.measurement.source == "gps0.position"]
    assert arrived == [event.t_receive_ns for event in kept]
    source = replay.summary("c.toml", {}, []).sources["gps0.position"]
    assert (source.withheld, source.events) == (len(fixes) - len(kept), len(fixes))
    assert source.withheld == 10


def test_the_ends_of_a_withheld_interval(setup: Config) -> None:
    seen: list[Receipt] = []
    task = ReplayTask(RATE, [parse_withheld("imu0:0.1-0.2", setup)], on_receipt=[seen.append])
    Replay(setup, task).run([imu(T0 + t * MS, t) for t in (0, 99, 100, 199, 200)])
    assert [receipt.measurement.sequence for receipt in seen] == [0, 99, 200]


# --- Summary


def test_summary_accounts_for_every_event(setup: Config, events: list[Received]) -> None:
    replay = Replay(setup, ReplayTask(RATE))
    replay.run([*events, Received("imu0", 10**6, "", None, events[-1].t_receive_ns, Invalid("broken"))])
    summary = replay.summary("c.toml", {"a.tlog": {"records": 1}}, ["odd"])
    assert summary.events == len(events) + 1
    assert sum(source.events for source in summary.sources.values()) + summary.clock_pairs == summary.events
    assert summary.sources["imu0"].invalid_reasons == {"broken": 1}
    assert (summary.config, summary.logs, summary.warnings) == ("c.toml", {"a.tlog": {"records": 1}}, ["odd"])
    assert summary.span.seconds == pytest.approx(6.0, abs=0.2)
    late = summary.sources["gps0.position"].latency_ms
    assert late is not None
    assert 100 < late.min <= late.p50 <= late.p90 <= late.p99 <= late.max < 200


def test_latency_counts_the_configured_delay(setup: Config) -> None:
    replay = Replay(setup, ReplayTask(RATE))
    replay.run([Received("rear_left", k, "", None, T0 + k * MS, WheelSpeed(1.0)) for k in range(10)])
    late = replay.summary("c.toml", {}, []).sources["rear_left"].latency_ms
    assert late is not None
    assert late.min == late.p50 == late.max == setup.can[setup.wheel["rear_left"].bus].delay_ms


def test_window_limits_the_comparison(setup: Config, events: list[Received]) -> None:
    first = events[0].t_receive_ns
    rows = [TruthSample(first + k * SECOND // 10, 48.137, 11.575, 560.0, 9.0, 0.0, 0.0) for k in range(60)]
    replay = Replay(setup, ReplayTask(10.0, truth=Truth(rows), window=Window(3.0, 5.0)))
    replay.run(events)
    found = replay.summary("c.toml", {}, []).truth
    assert found is not None
    assert (found.rows, found.start_s, found.stop_s) == (21, 3.0, 5.0)
