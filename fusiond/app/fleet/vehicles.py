"""The vehicles of a fleet as they were heard: of each the latest state and health, how old they are, and its alarms.

Hundreds of vehicles bring thousands of states a second. Only the latest of each is kept, and only decoded when someone
looks. Ages are by this machine's clock: the vehicles' clocks need not agree with it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from threading import Lock
from typing import Literal, NamedTuple

from fusiond.estimator.solution import Mode
from fusiond.messages.types import HealthMessage, StateMessage

SILENT_S = 2.0  # without a state, though the vehicle is there
PATIENCE_S = 60.0  # a mode other than nominal for longer, and resets within this time, are alarms
RATE_S = 2.0  # over which the rate of the states is measured
RANKS = {"critical": 0, "warning": 1}

Urgency = Literal["critical", "warning"]
AlarmKind = Literal["gone", "silent", "lost", "withheld", "not nominal", "reset", "source"]


class Alarm(NamedTuple):
    """Something that an operator should look at."""

    vehicle: str
    kind: AlarmKind
    urgency: Urgency
    text: str


class Vehicle:
    """What is known of one vehicle. Messages come from threads of Zenoh; `refresh` and what it fills in from one other."""

    def __init__(self, name: str, now_s: float) -> None:
        self.name = name
        self.states = 0  # heard
        self.present: bool | None = None  # whether its fusiond is connected; None: not known yet
        self.state: StateMessage | None = None  # as of the last refresh, as what follows
        self.health: HealthMessage | None = None
        self.age_s = 0.0  # since the last state was heard, or since it is known that there is a vehicle
        self.rate_hz = 0.0
        self._heard_s = now_s
        self._newest: Callable[[], StateMessage | None] | None = None
        self._newest_health: Callable[[], HealthMessage | None] | None = None
        self._counts: deque[tuple[float, int]] = deque()  # time, states by then
        self._mode: Mode | None = None
        self._mode_since_s = now_s
        self._resets: deque[float] = deque()  # when one was seen
        self._seen_resets: int | None = None

    # --- From Zenoh

    def hear_state(self, now_s: float, decode: Callable[[], StateMessage | None]) -> None:
        """A state came."""
        self.states += 1
        self._newest, self._heard_s = decode, now_s

    def hear_health(self, decode: Callable[[], HealthMessage | None]) -> None:
        """A health message came."""
        self._newest_health = decode

    # --- For those who look

    def refresh(self, now_s: float) -> None:
        """Take over what came."""
        newest, self._newest = self._newest, None
        if newest is not None and (state := newest()) is not None:
            self._take(state, now_s)
        newest_health, self._newest_health = self._newest_health, None
        if newest_health is not None:
            self.health = newest_health() or self.health
        self.age_s = now_s - self._heard_s
        self._counts.append((now_s, self.states))
        while len(self._counts) > 2 and self._counts[1][0] <= now_s - RATE_S:
            self._counts.popleft()
        (first_s, first), (last_s, last) = self._counts[0], self._counts[-1]
        self.rate_hz = (last - first) / (last_s - first_s) if last_s > first_s else 0.0
        while self._resets and self._resets[0] < now_s - PATIENCE_S:
            self._resets.popleft()

    def _take(self, state: StateMessage, now_s: float) -> None:
        self.state = state
        if state.mode is not self._mode:
            self._mode, self._mode_since_s = state.mode, now_s
        if self._seen_resets is not None and state.resets > self._seen_resets:
            self._resets.append(now_s)
        self._seen_resets = state.resets

    def alarms(self, now_s: float) -> Iterator[Alarm]:
        """What is wrong, the most urgent first."""
        if self.present is False:
            yield Alarm(self.name, "gone", "critical", "its fusiond or its link has ended")
            return
        if self.age_s > SILENT_S:
            yield Alarm(self.name, "silent", "critical", f"no state for {self.age_s:.0f} s")
            return
        state = self.state
        if state is None:
            return
        if state.mode is Mode.LOST:
            yield Alarm(self.name, "lost", "critical", "the state is lost")
        if state.fault:
            yield Alarm(self.name, "withheld", "critical", f"state withheld: {state.fault}")
        since_s = now_s - self._mode_since_s
        if state.mode in (Mode.ALIGNING, Mode.DEAD_RECKONING) and since_s > PATIENCE_S:
            yield Alarm(self.name, "not nominal", "warning", f"{state.mode.value.replace('_', ' ')} for {since_s:.0f} s")
        if self._resets:
            why = self.health.reset_reason if self.health else None
            yield Alarm(self.name, "reset", "warning", f"the state has jumped{f': {why}' if why else ''}")
        yield from self._of_sources()

    def _of_sources(self) -> Iterator[Alarm]:
        for name, source in self.health.sources.items() if self.health else ():
            if not source.present:
                yield Alarm(self.name, "source", "warning", f"nothing from {name}")
            elif source.status not in (None, "nominal"):
                why = f": {source.reason}" if source.reason else ""
                yield Alarm(self.name, "source", "warning", f"{name} {source.status}{why}")


class Fleet:
    """All vehicles that were ever heard. `hear_*` may be called from any thread."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._vehicles: dict[str, Vehicle] = {}
        self._lock, self._looking = Lock(), Lock()

    def _vehicle(self, name: str) -> Vehicle:
        found = self._vehicles.get(name)
        if found is None:
            with self._lock:
                found = self._vehicles.setdefault(name, Vehicle(name, self._clock()))
        return found

    def hear_state(self, vehicle: str, decode: Callable[[], StateMessage | None]) -> None:
        """A state came."""
        self._vehicle(vehicle).hear_state(self._clock(), decode)

    def hear_health(self, vehicle: str, decode: Callable[[], HealthMessage | None]) -> None:
        """A health message came."""
        self._vehicle(vehicle).hear_health(decode)

    def hear_presence(self, vehicle: str, present: bool) -> None:
        """A vehicle's fusiond has connected, or is gone."""
        self._vehicle(vehicle).present = present

    def look(self) -> Picture:
        """How all of them are now. From any thread."""
        with self._looking:
            return self._look()

    def _look(self) -> Picture:
        now_s = self._clock()
        with self._lock:
            vehicles = list(self._vehicles.values())
        alarms: dict[str, tuple[Alarm, ...]] = {}
        for vehicle in vehicles:
            vehicle.refresh(now_s)
            alarms[vehicle.name] = tuple(vehicle.alarms(now_s))
        return Picture(sorted(vehicles, key=lambda one: (_rank(alarms[one.name]), one.name)), alarms)


class Picture(NamedTuple):
    """All vehicles at one instant, those with the most urgent alarms first, and the alarms of each."""

    vehicles: list[Vehicle]
    alarms: dict[str, tuple[Alarm, ...]]


def _rank(alarms: tuple[Alarm, ...]) -> int:
    return min((RANKS[alarm.urgency] for alarm in alarms), default=len(RANKS))


class Changes:
    """Which alarms have begun and ended from one picture to the next."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str, str], Alarm] = {}

    def since(self, picture: Picture) -> list[tuple[bool, Alarm]]:
        """Whether each began, and the alarm."""
        now = {_identity(alarm): alarm for alarms in picture.alarms.values() for alarm in alarms}
        ended = [(False, alarm) for identity, alarm in self._known.items() if identity not in now]
        begun = [(True, alarm) for identity, alarm in now.items() if identity not in self._known]
        self._known = now
        return ended + begun


def _identity(alarm: Alarm) -> tuple[str, str, str]:
    """What stays the same while an alarm lasts: of those of sources the source too."""
    return alarm.vehicle, alarm.kind, alarm.text if alarm.kind == "source" else ""
