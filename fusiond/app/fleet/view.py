"""The screen of `fusiond fleet`: one line a vehicle, those with alarms first."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from fusiond.app.fleet.vehicles import SILENT_S, Alarm, Picture, Urgency, Vehicle
from fusiond.app.top.view import MODES, Colour, Line, Place, Span, compass, printable, scrolled, table
from fusiond.messages.types import State

HEADS = ("VEHICLE", "mode", "age s", "Hz", "latitude", "longitude", "sigma m", "m/s", "course", "resets", "alarms")
URGENCIES: dict[Urgency, Colour] = {"critical": "red", "warning": "yellow"}


def screen(picture: Picture, width: int) -> list[Line]:
    """All lines."""
    return [printable(line) for line in (_title(picture), *_lines(picture, width))]


def page(picture: Picture, width: int, height: int, place: Place) -> list[Line]:
    """What a terminal of this size shows. `place` is kept inside."""
    title, *lines = screen(picture, width)

    def below(room: int) -> Line:
        last = min(len(lines), place.top + room)
        where = f"arrows: {place.top + 1}-{last} of {len(lines)} lines" if len(lines) > room else "arrows"
        return Span("q quit  ", "dim"), Span(where, "bold" if last < len(lines) else "dim")

    return scrolled(title, lines, width, height, place, below)


def _title(picture: Picture) -> Line:
    modes = Counter(_mode(vehicle)[0] for vehicle in picture.vehicles)
    told = ", ".join(f"{count} {mode}" for mode, count in sorted(modes.items()))
    urgencies = Counter(alarm.urgency for alarms in picture.alarms.values() for alarm in alarms)
    alarms = tuple(
        Span(f"  {urgencies[urgency]} {urgency}", colour) for urgency, colour in URGENCIES.items() if urgencies[urgency]
    )
    return Span(f"{len(picture.vehicles)} vehicles  ", "bold"), Span(told or "none heard yet"), *alarms


def _lines(picture: Picture, width: int) -> Iterator[Line]:
    if picture.vehicles:
        yield from table(HEADS, [list(_row(one, picture.alarms[one.name])) for one in picture.vehicles], width)


def _row(vehicle: Vehicle, alarms: Sequence[Alarm]) -> Iterator[Span]:
    mode, colour = _mode(vehicle)
    yield Span(vehicle.name, URGENCIES[alarms[0].urgency] if alarms else "plain")
    yield Span(mode, colour)
    yield Span(f"{vehicle.age_s:.1f}", "red" if vehicle.age_s > SILENT_S else "plain")
    yield Span(f"{vehicle.rate_hz:.0f}")
    message = vehicle.state
    yield from _motion(message.state if message else None)
    yield Span(str(message.resets) if message else "-")
    text = "; ".join(alarm.text for alarm in alarms)
    yield Span(text, URGENCIES[alarms[0].urgency] if alarms else "plain")


def _mode(vehicle: Vehicle) -> tuple[str, Colour]:
    if vehicle.present is False:
        return "gone", "red"
    if vehicle.state is None:
        return "no state", "yellow"
    return vehicle.state.mode.value.replace("_", " "), MODES[vehicle.state.mode]


def _motion(state: State | None) -> Iterator[Span]:
    if state is None:
        yield from (Span("-") for _ in range(5))
        return
    north, east, _ = state.velocity_ned_mps
    yield Span(compass(state.lat_deg, "NS"))
    yield Span(compass(state.lon_deg, "EW"))
    yield Span(f"{math.hypot(*state.sigma_position_ned_m[:2]):.2f}")
    yield Span(f"{math.hypot(north, east):.1f}")
    yield Span(f"{math.degrees(math.atan2(east, north)) % 360:.0f}")
