"""The reader of the system tests: subscribes to a vehicle's state over Zenoh, and compares it with the truth."""

from __future__ import annotations

import csv
import json
import math
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from threading import Condition
from typing import Any, NamedTuple

import zenoh

SECOND = 1_000_000_000  # ns
METRES_PER_DEGREE = 111_320.0


class Arrival(NamedTuple):
    """A state as received."""

    t_ns: int  # monotonic
    payload: bytes

    def decoded(self) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(self.payload)
        return message


class Reader:
    """All states received so far."""

    def __init__(self) -> None:
        self.arrivals: list[Arrival] = []
        self.is_connected: Callable[[], bool] = lambda: False  # whether the publisher knows of this reader
        self._came = Condition()

    def receive(self, sample: zenoh.Sample) -> None:
        """Called in Zenoh's thread."""
        arrival = Arrival(time.monotonic_ns(), sample.payload.to_bytes())
        with self._came:
            self.arrivals.append(arrival)
            self._came.notify_all()

    def since(self, t_ns: int, until_ns: int | None = None) -> list[Arrival]:
        """The states received between two instants."""
        begin = bisect_left(self.arrivals, t_ns, key=lambda arrival: arrival.t_ns)
        end = None if until_ns is None else bisect_left(self.arrivals, until_ns, key=lambda arrival: arrival.t_ns)
        return self.arrivals[begin:end]

    def first(self, t_ns: int, wanted: Callable[[dict[str, Any]], bool], timeout_s: float) -> Arrival | None:
        """The first state after an instant that fulfils a condition; None if none comes in time."""
        at = len(self.arrivals) - len(self.since(t_ns))
        ends = time.monotonic() + timeout_s
        while True:
            while at < len(self.arrivals):
                if wanted(self.arrivals[at].decoded()):
                    return self.arrivals[at]
                at += 1
            with self._came:
                if at == len(self.arrivals) and not self._came.wait(max(0.0, ends - time.monotonic())):
                    return None
            if time.monotonic() > ends:
                return None

    def longest_gap(self, t_ns: int, until_ns: int) -> float:
        """The longest time without a state between two instants [s]."""
        times = [t_ns, *(arrival.t_ns for arrival in self.since(t_ns, until_ns)), until_ns]
        return max(b - a for a, b in pairwise(times)) / SECOND


@contextmanager
def reading(name: str, endpoint: str) -> Iterator[Reader]:
    """A subscriber that finds its publisher again within a tenth of a second."""
    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 100},
        "scouting/multicast/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    reader = Reader()
    with zenoh.open(config) as session, session.declare_subscriber(f"fusiond/{name}/state", reader.receive):
        reader.is_connected = lambda: any(True for _ in session.liveliness().get(f"fusiond/{name}/@alive/state"))
        yield reader


class Truth:
    """The positions of the vehicle, from a truth.csv."""

    def __init__(self, path: Path) -> None:
        with path.open(encoding="ascii", newline="") as file:
            rows = list(csv.DictReader(file))
        self._t_ns = [1000 * int(row["unix_us"]) for row in rows]
        self._places = [(float(row["lat_deg"]), float(row["lon_deg"])) for row in rows]

    def error_m(self, t_ns: int, message: dict[str, Any]) -> float | None:
        """Horizontal distance of a state from the truth at an instant of the recording; None without either."""
        at = bisect_left(self._t_ns, t_ns)
        state = message["state"]
        if state is None or at == 0 or at == len(self._t_ns):
            return None
        part = (t_ns - self._t_ns[at - 1]) / (self._t_ns[at] - self._t_ns[at - 1])
        (lat_0, lon_0), (lat_1, lon_1) = self._places[at - 1], self._places[at]
        north = (state["lat_deg"] - lat_0 - part * (lat_1 - lat_0)) * METRES_PER_DEGREE
        east = (state["lon_deg"] - lon_0 - part * (lon_1 - lon_0)) * METRES_PER_DEGREE * math.cos(math.radians(lat_0))
        return math.hypot(north, east)
