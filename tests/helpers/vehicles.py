"""Vehicles of a fleet for its tests: states and health messages, and vehicles that publish through a router on loopback."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from msgspec.structs import replace

from fusiond.config.outputs import Zenoh
from fusiond.estimator.solution import Mode
from fusiond.messages.types import HealthMessage, LatencyHealth, OutcomeCounts, SourceHealth, StateMessage
from fusiond_adapters.zenoh.session import ZenohPublisher, open_session
from tests.helpers.published import message
from tests.helpers.zenoh import endpoint


def state(vehicle: str, mode: Mode = Mode.NOMINAL, resets: int = 0, fault: str | None = None) -> StateMessage:
    return replace(message(mode=mode, speed=3.0), vehicle=vehicle, resets=resets, fault=fault)


def health(vehicle: str, **sources: str) -> HealthMessage:
    """A health with sources by their status; "silent" for one that sends nothing."""
    made = {
        name: SourceHealth(
            outcomes=OutcomeCounts(), present=status != "silent",
            status="absent" if status == "silent" else status,  # type: ignore[arg-type]
            reason="it repeats one value" if status == "frozen" else None,
        )
        for name, status in sources.items()
    }  # fmt: skip
    return HealthMessage(
        vehicle=vehicle, t_ns=1, version="1", uptime_s=1.0, mode=Mode.NOMINAL, resets=0, reset_reason="a jump of the clock",
        outcomes=OutcomeCounts(), latency_ms=LatencyHealth(), sources=made, inputs={}, outputs={},
    )  # fmt: skip


@contextmanager
def yard(names: Sequence[str]) -> Iterator[tuple[str, dict[str, ZenohPublisher]]]:
    """The endpoint of a router, and the publisher of each vehicle, with a session of its own."""
    where = endpoint()
    with ExitStack() as stack:
        stack.enter_context(open_session(Zenoh(mode="router", listen=[where])))
        section = Zenoh(mode="client", listen=[], connect=[where])
        made = {
            name: stack.enter_context(ZenohPublisher(stack.enter_context(open_session(section)), name, "json"))
            for name in names
        }
        yield where, made
