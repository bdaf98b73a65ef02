"""Outputs of a daemon: supervision, isolation, and what is published besides the state."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import count, pairwise
from pathlib import Path
from threading import Condition, Event

import can
import numpy as np
import pytest

from fusiond.app.client import Client
from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.config import load as config
from fusiond.config.outputs import Zenoh
from fusiond.config.schema import Config
from fusiond.messages.codec import encode
from fusiond.messages.types import (
    ConfigMessage,
    EventMessage,
    HealthMessage,
    InfoMessage,
    InnovationMessage,
    Message,
    SettledMessage,
    StateAtInstant,
    StateMessage,
)
from fusiond.ports.outputs import Outbox, OutputLost
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.zenoh.session import open_session
from tests.helpers.live import Autopilot, Running, aligned, configuration, drive, fused, running
from tests.helpers.network import DEADLINE, free_port
from tests.helpers.zenoh import sees

CHANNELS = count()


@pytest.fixture
def channel() -> str:
    return f"outputs-{next(CHANNELS)}"


@pytest.fixture
def bus(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=channel) as opened:
        yield opened


class Collector:
    """An output that keeps what it gets. `faults` are raised one by one, each by a session."""

    def __init__(self, name: str = "collector", faults: Sequence[Exception] = (), size: int = 100_000) -> None:
        self.name = self.about = name
        self.outbox = Outbox(size, (Message,))
        self.got: list[Message] = []
        self.sessions = 0
        self._faults = iter(faults)
        self._changed = Condition()

    def session(self, stop: Event) -> None:
        self.sessions += 1
        for fault in self._faults:
            raise fault
        stopping = False
        while not stopping:
            stopping = stop.is_set()
            messages = self.outbox.take(0 if stopping else 0.2)
            with self._changed:
                self.got += messages
                self._changed.notify_all()

    def counts(self) -> dict[str, int]:
        return {"sessions": self.sessions}

    def notes(self) -> dict[str, str]:
        return {"mood": "good"}

    def of(self, kind: type[Message]) -> list[Message]:
        return [message for message in self.got if type(message) is kind]


class Stalled(Collector):
    """An output whose consumer never finishes its first message."""

    def __init__(self) -> None:
        super().__init__("stalled", size=16)
        self.stuck = Event()

    def session(self, stop: Event) -> None:
        self.got += self.outbox.take(DEADLINE)
        self.stuck.set()
        stop.wait()


@contextmanager
def driven(
    folder: Path, channel: str, outputs: list[Collector], more: str = "", *, zenoh: bool = False
) -> Iterator[tuple[Running, Callable[[Callable[[], bool]], None]]]:
    """A daemon with outputs, and a function that plays autopilot and wheels until a condition holds."""
    port = free_port()
    settings = configuration(folder, f"udpin:127.0.0.1:{port}", more, channel)
    autopilot = Autopilot()
    with (
        running(settings, outputs=outputs, zenoh=zenoh) as run,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as peer,
        can.Bus(interface="virtual", channel=channel) as wheels,
    ):
        yield run, lambda until: drive(run, lambda data: peer.sendto(data, ("127.0.0.1", port)), wheels, until, autopilot)


# --- Supervision


def test_a_stalled_and_a_failing_output_delay_nothing_else(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    good, stalled = Collector(), Stalled()
    faulty = Collector("faulty", [OutputLost("no consumer"), ZeroDivisionError("a driver's"), OutputLost("again")])
    with driven(tmp_path, channel, [good, stalled, faulty]) as (run, drive_until):
        drive_until(lambda: aligned(run) and len(run.messages) > 100 and stalled.stuck.is_set() and faulty.sessions == 4)
        outboxes = run.daemon.outputs["stalled"].outbox
        assert run.daemon.losses()["stalled messages dropped"] == outboxes.dropped > 50
    assert good.of(StateMessage) == run.messages  # each of them, in order, those at the very end as well
    assert good.outbox.dropped == 0 and good.sessions == 1
    introduced = [type(message) for message in good.got if isinstance(message, InfoMessage | ConfigMessage)]
    assert introduced == [InfoMessage, ConfigMessage]
    last = good.of(HealthMessage)[-1]
    assert isinstance(last, HealthMessage)
    assert last.outputs["stalled"].dropped > 0 and last.outputs["faulty"].counts == {"sessions": 4}
    assert last.outputs["collector"].notes == {"mood": "good"} and last.outputs["collector"].latency_ms is not None


# --- What is published


def settled_state(collector: Collector) -> bool:
    latest = collector.of(SettledMessage)[-1:]
    return any(isinstance(message, SettledMessage) and message.state is not None for message in latest)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Config, Path, list[Message], Running]:
    """One drive: configuration, black box, everything published, the daemon after its end."""
    folder, channel, collector = tmp_path_factory.mktemp("drive"), f"outputs-{next(CHANNELS)}", Collector()
    with driven(folder, channel, [collector], '[record]\nfolder = "box"\n') as (run, drive_until):
        drive_until(lambda: aligned(run) and fused(run, "left") > 90 and settled_state(collector))
    return run.daemon.config, folder / "box", collector.got, run


def of_kind(messages: list[Message], kind: type[Message]) -> list[Message]:
    return [message for message in messages if type(message) is kind]


def test_the_health_accounts_for_everything(recorded: tuple[Config, Path, list[Message], Running]) -> None:
    _, _, messages, _ = recorded
    healths = [message for message in messages if isinstance(message, HealthMessage)]
    health = healths[-1]
    assert set(health.sources) == {"imu0", "gps0.position", "gps0.velocity", "left", "right"}
    assert health.inputs["mavlink.fc"].received > 100 and health.inputs["can.car"].dropped == 0
    latency = health.latency_ms
    assert latency.fused is not None and 0 < latency.fused.p50 <= latency.fused.p99 <= latency.fused.max
    assert latency.published is not None and latency.published.p50 > 0
    for name, source in health.sources.items():
        assert source.present and source.age_ms is not None and source.age_ms < 2000, name
        assert source.clock is not None
    assert health.sources["imu0"].rate_hz > 10
    clock = health.sources["imu0"].clock
    assert clock is not None and clock.name == "fc/7/boot" and clock.method == "least_offset" and clock.offset_ms > 1e9
    assert clock.jitter_ms >= 0
    left = health.sources["left"]
    assert left.test_ratio is not None and left.nis_mean is not None and left.nis_mean >= 0
    assert health.outputs["record"].offered > 100 and health.outputs["record"].dropped == 0
    total = [sum(getattr(source.outcomes, name) for source in health.sources.values()) for name in ("fused", "rejected")]
    assert total == [health.outcomes.fused, health.outcomes.rejected]
    seconds = {message.t_ns // 10**9 for message in healths}
    assert len(healths) <= len(seconds) + 1 + len(of_kind(messages, EventMessage))


def test_events_report_modes_and_sources_once(recorded: tuple[Config, Path, list[Message], Running]) -> None:
    events = [(message.kind, message.subject) for message in recorded[2] if isinstance(message, EventMessage)]
    assert [subject for kind, subject in events if kind == "mode"] == ["aligning", "nominal"]
    found = [subject for kind, subject in events if kind == "source_found"]
    assert sorted(found) == ["gps0.position", "gps0.velocity", "imu0", "left", "right"]


def test_every_measurement_has_an_innovation(recorded: tuple[Config, Path, list[Message], Running]) -> None:
    _, _, messages, run = recorded
    innovations = [message for message in messages if isinstance(message, InnovationMessage)]
    wheels = [message for message in innovations if message.source == "left"]
    assert len(wheels) == len({message.t_receive_ns for message in wheels})
    outcomes = run.daemon.live.engine.fusion.outcomes()["left"]
    assert sum(outcomes.values()) - len(wheels) <= outcomes["WAITING"] + 2  # received after the last tick
    judged = [message for message in wheels if message.test_ratio is not None]
    assert len(judged) > 20  # the others were used for alignment
    for message in judged:
        (innovation,), (variance,) = message.innovation, message.variance
        assert variance > 0 and message.test_ratio is not None
        assert message.test_ratio == pytest.approx(innovation**2 / variance / 10.83, rel=0.01)  # chi-square, 1, 0.999
    assert {message.source for message in innovations} == {"left", "right", "gps0.position", "gps0.velocity"}


def test_no_covariance_is_torn(recorded: tuple[Config, Path, list[Message], Running]) -> None:
    """Every published covariance is symmetric, positive, and agrees with the sigmas, long after it was published."""
    states = [message for message in recorded[2] if isinstance(message, StateAtInstant) and message.state is not None]
    assert {type(message) for message in states} == {StateMessage, SettledMessage}
    for message in states:
        state = message.state
        assert state is not None
        for block in (state.covariance_position_m2, state.covariance_velocity_m2ps2, state.covariance_attitude_rad2):
            matrix = np.array(block).reshape(3, 3)
            assert np.array_equal(matrix, matrix.T)
            assert np.linalg.eigvalsh(matrix)[0] > 0
        assert state.sigma_position_ned_m == tuple(np.sqrt(np.diag(np.reshape(state.covariance_position_m2, (3, 3)))))
        with pytest.raises(AttributeError):
            state.covariance_position_m2 = state.covariance_velocity_m2ps2  # type: ignore[misc]


def test_the_settled_state_lags_by_the_horizon(recorded: tuple[Config, Path, list[Message], Running]) -> None:
    settings, _, messages, _ = recorded
    state, lags = None, []
    for message in messages:
        if isinstance(message, StateMessage):
            state = message
        elif isinstance(message, SettledMessage):
            assert state is not None
            lags.append((state.t_ns - message.t_ns) / 1e9)
    stamps = [message.t_ns for message in messages if isinstance(message, SettledMessage)]
    assert stamps == sorted(set(stamps))
    assert all(settings.filter.horizon_s <= lag < settings.filter.horizon_s + 0.5 for lag in lags)


def test_a_replay_of_the_black_box_publishes_the_same(recorded: tuple[Config, Path, list[Message], Running]) -> None:
    """State, settled state, innovations and events are the same bytes; the health except inputs, outputs, latencies."""
    settings, box, live, _ = recorded
    again: list[Message] = []
    Replay(settings, ReplayTask(settings.publish.rate_hz, on_message=[again.append])).run(
        open_logs([str(file) for file in sorted(box.glob("*log"))], settings)
    )
    for kind in (StateMessage, SettledMessage, InnovationMessage, EventMessage):
        expected, found = of_kind(live, kind), of_kind(again, kind)
        assert len(found) > 1
        assert [encode(message, "json") for message in expected[: len(found)]] == [encode(m, "json") for m in found]
    shell = {"latency_ms", "inputs", "outputs"}
    for one, other in zip(of_kind(live, HealthMessage), of_kind(again, HealthMessage), strict=False):
        left, right = json.loads(encode(one, "json")), json.loads(encode(other, "json"))
        assert {name: value for name, value in left.items() if name not in shell} == {
            name: value for name, value in right.items() if name not in shell
        }


def test_info_and_config_say_what_runs(recorded: tuple[Config, Path, list[Message], Running]) -> None:
    settings, _, messages, _ = recorded
    info = next(message for message in messages if isinstance(message, InfoMessage))
    assert info.sources["left"] == "wheel_speed" and info.sources["imu0"] == "imu"
    assert info.keys["innovations"] == "fusiond/test/innovations/*"
    published_config = next(message for message in messages if isinstance(message, ConfigMessage))
    assert published_config.config == info.config
    assert published_config.config["filter"]["heading_deg"] == settings.filter.heading_deg == 30.0
    assert "directory" not in published_config.config


def test_a_reload_is_published(tmp_path: Path) -> None:
    settings, collector = configuration(tmp_path, f"udpin:127.0.0.1:{free_port()}"), Collector()
    file = tmp_path / "live.toml"
    with running(settings, lambda: config.load(file), outputs=[collector]) as run:
        run.until(run.daemon.up.is_set)
        file.write_text(file.read_text().replace("reopen_max_s = 0.2", "reopen_max_s = 0.3"))
        run.call(run.daemon.reload)
        run.until(lambda: len(collector.of(ConfigMessage)) == 2)
    periods = [message.config["live"]["reopen_max_s"] for message in collector.got if isinstance(message, ConfigMessage)]
    assert periods == [0.2, 0.3]


# --- Zenoh


def test_a_router_that_dies_and_comes_back(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    """The estimator continues undisturbed; the reader gets the latest health again after the router is back."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    section = Zenoh(mode="router", listen=[endpoint])
    collector, heard = Collector(), []
    more = f'[zenoh]\nmode = "client"\nlisten = []\nconnect = ["{endpoint}"]\n'

    def zenoh_note(run: Running) -> str:
        return run.daemon.outputs["zenoh"].notes().get("session", "")

    router = open_session(section)
    try:
        with driven(tmp_path, channel, [collector], more, zenoh=True) as (run, drive_until):
            drive_until(lambda: aligned(run) and zenoh_note(run).startswith("1 router,"))
            with Client(endpoint, "test") as client, client.subscribed(StateMessage, heard.append):
                drive_until(lambda: len(heard) > 10)
                router.close()
                before = len(run.messages)
                drive_until(lambda: zenoh_note(run).startswith("0 routers") and len(run.messages) > before + 50)
                heard.clear()
                router = open_session(section)
                drive_until(lambda: len(heard) > 10)
                assert client.health().outputs["zenoh"].counts["sessions"] == 1  # Zenoh found its router by itself
    finally:
        router.close()
    assert collector.of(StateMessage) == run.messages and collector.outbox.dropped == 0
    assert {b.t_ns - a.t_ns for a, b in pairwise(run.messages)} == {10_000_000}


def test_a_router_away_at_first(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    more = f'[zenoh]\nmode = "client"\nlisten = []\nconnect = ["{endpoint}"]\n'
    with driven(tmp_path, channel, [], more, zenoh=True) as (run, drive_until):
        drive_until(lambda: len(run.messages) > 20)
        assert run.daemon.outputs["zenoh"].counts()["sent"] == 0
        with open_session(Zenoh(mode="router", listen=[endpoint])):
            drive_until(lambda: run.daemon.outputs["zenoh"].counts()["sent"] > 20)
            with Client(endpoint, "test") as client:
                assert sees(client, "test")


def test_a_stalled_subscriber_delays_nothing_else(tmp_path: Path, channel: str, bus: can.BusABC) -> None:
    """It hangs in its callback after one sample; another reader of the same daemon gets all that comes meanwhile."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    stuck, release, heard = Event(), Event(), []

    def hang(_: StateMessage) -> None:
        stuck.set()
        release.wait(DEADLINE)

    with driven(tmp_path, channel, [], f'[zenoh]\nlisten = ["{endpoint}"]\n', zenoh=True) as (run, drive_until):
        drive_until(lambda: len(run.messages) > 5)
        try:
            with Client(endpoint, "test") as slow, Client(endpoint, "test") as client:
                with slow.subscribed(StateMessage, hang), client.subscribed(StateMessage, heard.append):
                    drive_until(stuck.is_set)
                    heard.clear()
                    drive_until(lambda: len(heard) > 100)
                    release.set()
                stamps = [message.t_ns for message in heard]
                assert {b - a for a, b in pairwise(stamps)} == {10_000_000}
        finally:
            release.set()
        assert run.daemon.outputs["zenoh"].outbox.dropped == 0
