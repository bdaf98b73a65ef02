"""The live engine: a state is published before the work on the other messages, and nothing else changes by that."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common

from fusiond.app.live.daemon import Daemon
from fusiond.app.live.live_engine import MAX_FRAMES, LiveEngine
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.config.schema import Config
from fusiond.engine import Engine
from fusiond.events import Received
from fusiond.messages import Message, StateMessage
from fusiond.ports.inputs import Inbox
from fusiond.units import MICROSECOND, SECOND
from fusiond.units import MILLISECOND as MS
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.play import PlayedClock
from tests.helpers import drive
from tests.helpers.live import Autopilot, configuration

BEGIN_NS, STEP_MS = 1_760_000_000 * SECOND, 3  # samples: between ticks of 10 ms, sometimes at one
SAMPLES = 200


class Rig:
    """The engine of a daemon that does not run, on a clock that the test sets."""

    def __init__(self, folder: Path, *, on_imu: bool = False) -> None:
        self.clock = PlayedClock(BEGIN_NS, 1.0)
        settings = configuration(folder, "udpin:127.0.0.1:0")
        settings = replace(settings, publish=replace(settings.publish, on_imu=on_imu))
        daemon = Daemon(settings, zenoh=False, clock=self.clock)
        self.published: list[Message] = []
        self.inputs = daemon.inputs
        self.live = LiveEngine(daemon.config, self.clock.now_ns, self.published.append)
        self._autopilot = Autopilot()

    def receive(self, number: int) -> None:
        """An inertial sample arrives."""
        since_ns = number * STEP_MS * MS
        rest = (*(0.0,) * 7, 0x3F, 0)
        sample = common.MAVLink_highres_imu_message(since_ns // MICROSECOND + 10**7, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0, *rest)
        self.clock.set(BEGIN_NS + since_ns)
        self.inputs["mavlink.fc"].inbox.put(self.clock.now_ns(), self._autopilot.pack(sample))

    def fused(self) -> int:
        return int(self.live.engine.fusion.history.counts.sum())


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path)


def test_the_state_is_published_first_and_later_frames_wait(rig: Rig) -> None:
    rig.receive(0)  # and so the first tick, at which every message is published
    assert not rig.live.step(rig.inputs, give_way=True)
    assert [type(message) for message in rig.published] == [StateMessage]
    assert rig.live.engine.unfinished
    rig.live.engine.flush()
    assert len(rig.published) > 2
    assert not rig.live.engine.unfinished
    for number in range(1, 4):  # at 3, 6 and 9 ms
        rig.receive(number)
        assert not rig.live.step(rig.inputs, give_way=True)
    before, fused = len(rig.published), rig.fused()
    rig.receive(4)  # at 12 ms, so the tick at 10 ms comes before it
    assert rig.live.step(rig.inputs, give_way=True)
    assert [type(message) for message in rig.published[before:]] == [StateMessage]
    assert rig.fused() == fused
    assert not rig.live.step(rig.inputs, give_way=True)
    assert rig.fused() == fused + 1


def test_a_prepared_state_is_the_state_of_the_tick(tmp_path: Path) -> None:
    """Prepared after every sample, which is wasted if another comes before the tick: the same messages."""
    found = []
    for prepares in (False, True):
        rig, made = Rig(tmp_path), 0
        message = rig.live.engine.message

        def counted(t_ns: int, message: Callable[[int], StateMessage] = message) -> StateMessage:
            nonlocal made
            made += 1
            return message(t_ns)

        rig.live.engine.message = counted  # type: ignore[method-assign]
        for number in range(SAMPLES):
            rig.receive(number)
            rig.live.step(rig.inputs)
            if prepares:
                rig.live.engine.prepare()
                rig.live.engine.prepare()  # does nothing
        found.append((rig.published, made))
    (plain, ticks), (prepared, times) = found
    assert prepared == plain
    assert ticks == SAMPLES * STEP_MS // 10
    assert times == SAMPLES + SAMPLES // 10  # once after each sample, and at the ticks that come with one


def test_a_tick_that_waited_for_a_sample_gives_way_too(tmp_path: Path) -> None:
    """The tick of 10 ms is made with the sample at 12 ms; the two received meanwhile wait until its state is published."""
    rig = Rig(tmp_path, on_imu=True)
    for number in range(4):
        rig.receive(number)
        rig.live.step(rig.inputs, give_way=True)
    rig.live.engine.flush()
    before, fused = len(rig.published), rig.fused()
    for number in (4, 5, 6):
        rig.receive(number)
    assert rig.live.step(rig.inputs, give_way=True)
    (state,) = rig.published[before:]
    assert isinstance(state, StateMessage)
    assert state.t_ns == BEGIN_NS + 12 * MS
    assert rig.fused() == fused + 1
    assert not rig.live.step(rig.inputs, give_way=True)
    assert rig.fused() == fused + 3


def test_a_tick_that_waits_in_vain_is_made_after_half_a_period(tmp_path: Path) -> None:
    rig = Rig(tmp_path, on_imu=True)
    rig.receive(0)
    rig.live.step(rig.inputs)
    for since_ms, states in ((10, 1), (14, 1), (15, 2), (24, 2), (25, 3)):
        rig.clock.set(BEGIN_NS + since_ms * MS)
        rig.live.step(rig.inputs)
        assert sum(isinstance(message, StateMessage) for message in rig.published) == states


@pytest.mark.parametrize("on_imu", [False, True])
def test_giving_way_changes_no_message(tmp_path: Path, on_imu: bool) -> None:
    found = []
    for give_way in (False, True):
        rig = Rig(tmp_path, on_imu=on_imu)
        for number in range(SAMPLES):
            rig.receive(number)
            while rig.live.step(rig.inputs, give_way=give_way):
                pass
        rig.live.engine.flush()
        found.append(rig.published)
    assert sum(isinstance(message, StateMessage) for message in found[0]) == SAMPLES * STEP_MS // 10
    assert found[0] == found[1]


def test_after_a_stall_every_tick_is_made(rig: Rig) -> None:
    for number in range(SAMPLES):
        rig.receive(number)
    assert not rig.live.step(rig.inputs)
    states = [message for message in rig.published if isinstance(message, StateMessage)]
    assert [(state.t_ns - BEGIN_NS) // MS for state in states] == list(range(0, SAMPLES * STEP_MS, 10))
    assert isinstance(rig.published[0], StateMessage)


def test_many_frames_are_processed_in_parts(rig: Rig) -> None:
    for number in range(2 * MAX_FRAMES + 10):
        rig.receive(number)
    for part in range(1, 3):
        assert rig.live.step(rig.inputs)
        assert rig.fused() == part * MAX_FRAMES
    assert not rig.live.step(rig.inputs)
    assert rig.fused() == 2 * MAX_FRAMES + 10
    ticks = {message.t_ns for message in rig.published if isinstance(message, StateMessage)}
    assert len(ticks) == -(-(2 * MAX_FRAMES + 10) * STEP_MS // 10)


# --- Live and replay


class Played:
    """An input whose frames are events."""

    name = file = "played"

    def __init__(self) -> None:
        self.inbox: Inbox[Received] = Inbox(10**6, lambda: None, lambda event: event.source)

    def decode(self, item: Received, t_ns: int) -> list[Received]:
        return [replace(item, t_receive_ns=t_ns)]

    def record(self, item: Received, t_ns: int) -> bytes:
        return b""


def recorded(setup: Config) -> list[Received]:
    """The drive as in a black box: receipts increase by at least a microsecond."""
    found: list[Received] = []
    last_ns = 0
    for event in open_logs([str(drive.folder() / log) for log in drive.LOGS], setup):
        last_ns = max(last_ns + MICROSECOND, event.t_receive_ns // MICROSECOND * MICROSECOND)
        found.append(replace(event, t_receive_ns=last_ns))
    return found


def live_messages(setup: Config, events: list[Received], *, give_way: bool, batch: int) -> list[Message]:
    clock, played, published = PlayedClock(events[0].t_receive_ns, 1.0), Played(), list[Message]()
    live = LiveEngine(setup, clock.now_ns, published.append)
    for at in range(0, len(events), batch):
        for event in events[at : at + batch]:
            played.inbox.put(event.t_receive_ns, event)
        clock.set(events[min(at + batch, len(events)) - 1].t_receive_ns)
        while live.step({"played": played}, give_way=give_way):
            pass
    live.engine.flush()
    return published


def replayed_messages(setup: Config, events: list[Received]) -> list[Message]:
    published: list[Message] = []
    Replay(setup, ReplayTask(setup.publish.rate_hz, on_message=[published.append])).run(events)
    return published


@pytest.mark.parametrize("on_imu", [False, True])
@pytest.mark.parametrize(("give_way", "batch"), [(False, 1), (True, 1), (True, 7)])
def test_live_and_replay_make_the_same_messages(on_imu: bool, give_way: bool, batch: int) -> None:
    """Of all kinds, completely: neither has inputs and outputs."""
    setup = drive.settings()
    setup = replace(setup, publish=replace(setup.publish, on_imu=on_imu))
    events = recorded(setup)
    live = live_messages(setup, events, give_way=give_way, batch=batch)
    assert live == replayed_messages(setup, events)
    assert len({type(message) for message in live}) == 5


def test_live_and_replay_call_the_same_functions_from_feed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """For each event, in order, down to the history, which catches up after each frame of a live run, later in a replay."""
    compared = ("fusiond.engine", "fusiond.timeline", "fusiond.messages", "fusiond.estimator.fusion")
    setup = drive.settings()
    events = recorded(setup)[:600]
    feed = Engine.feed
    calls: list[list[str]] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        module = frame.f_globals.get("__name__", "")
        if event == "call" and module.startswith(compared):
            calls[-1].append(f"{module}.{frame.f_code.co_qualname}")

    def profiled(engine: Engine, event: Received) -> object:
        calls.append([])
        sys.setprofile(note)
        try:
            return feed(engine, event)
        finally:
            sys.setprofile(None)

    found = []
    monkeypatch.setattr(Engine, "feed", profiled)
    for run in (lambda: live_messages(setup, events, give_way=False, batch=600), lambda: replayed_messages(setup, events)):
        run()
        found.append(list(calls))
        calls.clear()
    live, replayed = found
    assert len(live) == len(events)
    assert live == replayed
    assert {"fusiond.estimator.fusion.Fusion.feed", "fusiond.messages.schedule.Publication.add"} <= set(live[-1])
