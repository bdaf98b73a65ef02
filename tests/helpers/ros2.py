"""Messages for the tests of the ROS 2 output, and the type definitions of rosbags."""

from __future__ import annotations

from typing import Any

from rosbags.typesys import Stores, get_typestore

from fusiond.estimator.solution import Mode
from fusiond.messages.types import HealthMessage, InputHealth, LatencyHealth, OutcomeCounts, SourceHealth, StateMessage
from fusiond.units import SECOND
from tests.helpers.estimates import random_state

STORE = get_typestore(Stores.ROS2_JAZZY)
T0 = 1_700_000_000 * SECOND


def state_numbered(number: int = 1, mode: Mode = Mode.NOMINAL, **given: Any) -> StateMessage:
    values: dict[str, Any] = {"state": random_state(number), "age_ms": 1.0, "resets": 0, **given}
    t_ns = T0 + 7 + number * 20_000_000
    return StateMessage(vehicle="rover", t_ns=t_ns, mode=mode, outcomes=OutcomeCounts(), **values)


def health(t_ns: int = T0 + 9, mode: Mode = Mode.NOMINAL, resets: int = 0, dropped: int = 0) -> HealthMessage:
    return HealthMessage(
        vehicle="rover",
        t_ns=t_ns,
        version="0",
        uptime_s=12.5,
        mode=mode,
        resets=resets,
        reset_reason="gnss.position: rejected for too long" if resets else None,
        outcomes=OutcomeCounts(fused=10, rejected=2),
        latency_ms=LatencyHealth(),
        sources={
            "gnss.position": SourceHealth(outcomes=OutcomeCounts(fused=4), present=True, age_ms=3.0, rate_hz=5.0),
            "wheel": SourceHealth(outcomes=OutcomeCounts(), present=False),
        },
        inputs={"mavlink.fc": InputHealth(received=100, dropped=dropped, counts={"bad": 1})},
        outputs={},
    )


def definitions(kind: str) -> tuple[str, dict[str, str]]:
    """The .msg text of a type, and of those inside it."""
    first, *rest = STORE.generate_msgdef(kind, ros_version=2)[0].split("=" * 80 + "\n")
    inside = (part.split("\n", 1) for part in rest)
    return first, {name.removeprefix("MSG: ").replace("/", "/msg/"): text for name, text in inside}
