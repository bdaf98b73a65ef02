"""The messages of ticks besides the state: resets with their reasons, gaps, the health when something changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from fusiond.config.schema import Config
from fusiond.engine import SECOND, Engine
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Received
from fusiond.filter.state import RESET_SOURCE, ResetReason, count_reset
from fusiond.messages import EventMessage, HealthMessage, InnovationMessage, Message
from tests.helpers.live import configuration

REASONS = {
    ResetReason.SOURCE_RETURNED: "gps0.position: the state contradicted it and was likelier to be wrong; set to it",
    ResetReason.INERTIAL_LIED: "the inertial sensor contradicted all others; its part was taken back",
}


class Player:
    """An engine and a simple drive."""

    def __init__(self, settings: Config) -> None:
        self.published: list[Message] = []
        self.engine = Engine(settings, self.published.append, rate_hz=10.0)

    def play(self, seconds: float, begin_s: float = 0.0, metres_off: Callable[[float], float] = lambda _: 0.0) -> None:
        """A vehicle at rest; its receiver has an error to the north [m] by the second."""
        for number in range(round(seconds * 50)):
            second, wobble = begin_s + number / 50, 0.01 * (number % 7 - 3)
            self._feed("imu0", second, ImuSample((wobble, 0.0, -9.81), (1e-4, wobble / 10, 0.0)))
            if number % 10 == 0:
                self.gnss(second + 1e-3, metres_off(second))
        self.engine.finish()

    def gnss(self, second: float, metres_off: float) -> None:
        latitude = math.radians(48.0) + metres_off / 6.4e6
        self._feed("gps0.position", second, GnssPosition(latitude, 0.2, 500.0, 0.5, 1.0))
        self._feed("gps0.velocity", second, GnssVelocity(0.0, 0.0, 0.0, 0.1))

    def _feed(self, source: str, second: float, payload: ImuSample | GnssPosition | GnssVelocity) -> None:
        t_ns = 1_700_000_000 * SECOND + round(second * SECOND)
        assert self.engine.feed(Received(source, t_ns, "unix", t_ns, t_ns, payload)) is not None


def test_a_jump_of_the_receiver_is_published(tmp_path: Path) -> None:
    """A receiver with a constant error of 300 m for 5 s is rejected, and fused again when it is right again."""
    player = Player(configuration(tmp_path, "udpin:127.0.0.1:1"))
    player.play(15.0, metres_off=lambda second: 300.0 if 4 < second < 9 else 0.0)
    messages = player.published
    events = [message for message in messages if isinstance(message, EventMessage)]
    assert [message.subject for message in events if message.kind == "mode"] == [
        "aligning", "nominal", "dead_reckoning", "nominal",
    ]  # fmt: skip
    assert not [message for message in events if message.kind == "reset"]
    positions = [m for m in messages if isinstance(m, InnovationMessage) and m.source == "gps0.position"]
    rejected = [message for message in positions if message.outcome == "rejected"]
    assert len(rejected) >= 24 and all((message.test_ratio or 0) > 1 for message in rejected[:24])
    assert rejected[0].innovation[0] == pytest.approx(300, abs=2)
    assert all(message.outcome == "fused" for message in positions[-20:])


@pytest.mark.parametrize(("reason", "why"), REASONS.items(), ids=lambda value: getattr(value, "name", ""))
def test_a_reset_is_published_with_its_reason(tmp_path: Path, reason: ResetReason, why: str) -> None:
    player = Player(configuration(tmp_path, "udpin:127.0.0.1:1"))
    player.play(3.0)
    head = player.engine.fusion.history.head
    count_reset(head, reason)
    head.stamps[RESET_SOURCE] = player.engine.fusion.params.sources.index("gps0.position")
    player.play(1.0, begin_s=3.0)
    messages = player.published
    events = [message for message in messages if isinstance(message, EventMessage)]
    assert [message.text for message in events if message.kind == "reset"] == [f"state reset: {why}"]
    health = [message for message in messages if isinstance(message, HealthMessage)]
    assert (health[-1].resets, health[-1].reset_reason) == (1, why)
    jump = next(message for message in health if message.resets == 1)
    assert jump.t_ns == next(message.t_ns for message in events if message.kind == "reset")  # at once


def test_a_gap_in_the_data_is_published(tmp_path: Path) -> None:
    settings = configuration(tmp_path, "udpin:127.0.0.1:1")
    settings = msgspec.structs.replace(settings, filter=msgspec.structs.replace(settings.filter, restart_gap_s=3.0))
    player = Player(settings)
    player.play(2.0)
    player.play(2.0, begin_s=7.0)
    texts = [message.text for message in player.published if isinstance(message, EventMessage)]
    assert "state reset: no data for more than 3 s; aligning again" in texts
    assert "imu0: nothing received for 2 s" in texts


def test_a_source_that_never_came_is_absent(tmp_path: Path) -> None:
    """The inertial sensor, so that nothing can begin; the receiver and the wheels come, or not."""
    player = Player(configuration(tmp_path, "udpin:127.0.0.1:1"))
    for number in range(50):
        player.gnss(number / 10, 0.0)
    player.engine.finish()
    health = [message for message in player.published if isinstance(message, HealthMessage)][-1]
    statuses = {name: source.status for name, source in health.sources.items()}
    assert statuses == {"imu0": "absent", "gps0.position": "nominal", "gps0.velocity": "nominal", "left": "absent",
                        "right": "absent"}  # fmt: skip
    assert health.sources["imu0"].reason == "not received for 4.0 s"
    lost = [m.text for m in player.published if isinstance(m, EventMessage) and m.kind == "source_lost"]
    assert lost == [f"{source}: not received for 3.0 s" for source in ("imu0", "left", "right")]  # once


def test_a_clock_at_another_speed_is_named(tmp_path: Path) -> None:
    """A simulator at double speed: no sample is used, and the reason is said."""
    player = Player(configuration(tmp_path, "udpin:127.0.0.1:1"))
    start = 1_700_000_000 * SECOND
    for number in range(50 * 15):
        t_ns = number * SECOND // 50
        sample = ImuSample((0.01 * (number % 7), 0.0, -9.81), (1e-4, 0.0, 0.0))
        player.engine.feed(Received("imu0", number, "fc/7/boot", SECOND + 2 * t_ns, start + t_ns, sample))
    player.engine.finish()
    events = [m for m in player.published if isinstance(m, EventMessage) and m.kind == "clock"]
    assert [(event.subject, event.severity) for event in events] == [("fc/7/boot", "critical")]
    assert events[0].text.startswith("clock fc/7/boot: unusable: it runs 2.0000 times as fast as the host's")
    health = [message for message in player.published if isinstance(message, HealthMessage)][-1]
    clock = health.sources["imu0"].clock
    assert clock is not None and clock.drift_ppm == pytest.approx(-1e6)
    assert player.engine.fusion.invalid["imu0"]["its clock drifts too fast"] > 100
