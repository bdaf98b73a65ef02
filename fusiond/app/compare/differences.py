"""What differs between two tracks, when, and by how much against their sigmas."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fusiond.app.compare.series import NUMBERS, Series, SeriesError
from fusiond.app.replay.summary import table
from fusiond.app.replay.truth import MAX_GAP_NS
from fusiond.maths.typed import Array, Stamps
from fusiond.maths.wgs84 import radii
from fusiond.units import SECOND

APART = 3.0  # sigmas: tracks that are further apart contradict each other
JOIN_S = 1.0  # stretches closer than this are one
SHOWN = 8  # stretches that the text lists


class Difference(Struct, frozen=True, kw_only=True):
    """How far one quantity of the second track is off the first's: of vectors the length."""

    unit: str
    rms: float
    p95: float
    max: float
    max_at_s: float
    rms_sigmas: float | None  # in units of both tracks' sigmas together; None where a track has none
    max_sigmas: float | None
    max_sigmas_at_s: float | None
    sigma_ratio: float | None  # the second's sigma over the first's, median


class Apart(Struct, frozen=True, kw_only=True):
    """A stretch in which the tracks contradict each other, or their modes differ."""

    start_s: float
    stop_s: float
    what: str
    most: str


class Differences(Struct, frozen=True, kw_only=True):
    """The second track compared with the first. Seconds count from the first state of either."""

    first: str
    second: str
    origin_ns: int
    states: int  # compared
    alone: tuple[int, int]  # states of each that the other has none to compare with
    start_s: float
    stop_s: float
    quantities: dict[str, Difference]
    apart: list[Apart]


def differences(first: Series, second: Series) -> Differences:
    """Compare at the instants of the track with fewer states, where the other has states on both sides, at most 2 s apart.
    Raises SeriesError where there are none."""
    swapped = len(second.t_ns) < len(first.t_ns)
    few, many = (second, first) if swapped else (first, second)
    found, inside = _at(many, few.t_ns)
    if not inside.any():
        raise SeriesError(f"{first.name} and {second.name} have no instant in common")
    few = Series(few.name, few.t_ns[inside], few.numbers[inside], few.mode[inside])
    many = Series(many.name, few.t_ns, found[inside], _nearest(many, few.t_ns))
    one, other = (many, few) if swapped else (few, many)
    origin_ns = int(min(first.t_ns[0], second.t_ns[0]))
    t = (few.t_ns - origin_ns) / SECOND
    quantities, apart = {}, list[Apart]()
    for name, unit, off, sigmas in _offs(one, other):
        if not np.isfinite(off).any():
            continue  # one of them does not have it
        quantities[name] = _difference(unit, t, off, *sigmas)
        apart += _stretches(t, off, sigmas, name, unit)
    modes = (one.mode != other.mode) & (one.mode != "") & (other.mode != "")
    for begin, end in _runs(t, modes):
        apart.append(
            Apart(start_s=t[begin], stop_s=t[end], what="mode", most=f"{one.mode[begin]} and {other.mode[begin]}")
        )
    return Differences(
        first=first.name,
        second=second.name,
        origin_ns=origin_ns,
        states=len(t),
        alone=(_alone(first, few.t_ns), _alone(second, few.t_ns)),
        start_s=float(t[0]),
        stop_s=float(t[-1]),
        quantities=quantities,
        apart=sorted(apart, key=lambda one: (one.start_s, one.what)),
    )


def _at(series: Series, t_ns: Stamps) -> tuple[Array, NDArray[np.bool_]]:
    """The numbers of a track at instants, interpolated linearly, angles the short way round; and where there are any."""
    after = np.clip(np.searchsorted(series.t_ns, t_ns), 1, max(len(series.t_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(series.t_ns) - 1)
    span = series.t_ns[after] - series.t_ns[before]
    share = np.where(span > 0, (t_ns - series.t_ns[before]) / np.maximum(span, 1), 0.0)[:, None]
    change = series.numbers[after] - series.numbers[before]
    for name in ("lon_deg", "roll_deg", "yaw_deg"):
        column = change[:, NUMBERS.index(name)]
        change[:, NUMBERS.index(name)] = (column + 180.0) % 360.0 - 180.0
    exact = (t_ns == series.t_ns[before]) | (t_ns == series.t_ns[after])
    inside = (t_ns >= series.t_ns[0]) & (t_ns <= series.t_ns[-1]) & (exact | (span <= MAX_GAP_NS))
    return series.numbers[before] + share * change, inside


def _nearest(series: Series, t_ns: Stamps) -> NDArray[np.str_]:
    """The mode of the last state before each instant."""
    return series.mode[np.maximum(np.searchsorted(series.t_ns, t_ns, "right") - 1, 0)]


def _alone(series: Series, compared: Stamps) -> int:
    return int(np.count_nonzero((series.t_ns < compared[0]) | (series.t_ns > compared[-1])))


def _offs(one: Series, other: Series) -> Iterator[tuple[str, str, Array, tuple[Array, Array]]]:
    """Name, unit, distance (N,) and the sigmas (N,) of both, of each quantity."""

    def off(column: str) -> Array:
        return other.column(column) - one.column(column)

    meridian, transverse = np.array([radii(float(lat)) for lat in np.radians(one.column("lat_deg"))]).T
    north = np.radians(off("lat_deg")) * (meridian + one.column("height_m"))
    turned = np.radians((off("lon_deg") + 180.0) % 360.0 - 180.0)
    east = turned * (transverse + one.column("height_m")) * np.cos(np.radians(one.column("lat_deg")))

    def sigmas(*columns: str) -> tuple[Array, Array]:
        first, second = (np.sqrt(sum(s.column(c) ** 2 for c in columns)) for s in (one, other))
        return np.asarray(first), np.asarray(second)

    yield "horizontal position", "m", np.hypot(north, east), sigmas("sigma_n_m", "sigma_e_m")
    yield "height", "m", np.abs(off("height_m")), sigmas("sigma_d_m")
    speed = np.hypot(off("vn_mps"), off("ve_mps"))
    yield "horizontal velocity", "m/s", speed, sigmas("sigma_v_mps", "sigma_v_mps")  # that is of one axis
    yield "heading", "deg", np.abs((off("yaw_deg") + 180.0) % 360.0 - 180.0), sigmas("sigma_yaw_deg")


def _difference(unit: str, t: Array, off: Array, first: Array, second: Array) -> Difference:
    known = np.isfinite(off)
    t, off, first, second = t[known], off[known], first[known], second[known]
    worst = int(np.argmax(off))
    sigma = np.hypot(first, second)
    judged = np.isfinite(sigma) & (sigma > 0)
    whole = bool(judged.any())
    ratio = np.where(judged, off / np.where(judged, sigma, 1.0), 0.0)
    strangest = int(np.argmax(ratio))
    return Difference(
        unit=unit,
        rms=math.sqrt(float((off**2).mean())),
        p95=float(np.quantile(off, 0.95)),
        max=float(off[worst]),
        max_at_s=float(t[worst]),
        rms_sigmas=math.sqrt(float((ratio[judged] ** 2).mean())) if whole else None,
        max_sigmas=float(ratio[strangest]) if whole else None,
        max_sigmas_at_s=float(t[strangest]) if whole else None,
        sigma_ratio=float(np.median(second[judged] / first[judged])) if whole and (first[judged] > 0).all() else None,
    )


def _runs(t: Array, where: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and last place of the stretches in which a condition holds, those closer than JOIN_S joined."""
    places = np.flatnonzero(where)
    if not len(places):
        return
    breaks = np.flatnonzero(np.diff(t[places]) > JOIN_S)
    begins, ends = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(places) - 1]])
    for begin, end in zip(begins, ends, strict=True):
        yield int(places[begin]), int(places[end])


def _stretches(t: Array, off: Array, sigmas: tuple[Array, Array], name: str, unit: str) -> Iterator[Apart]:
    """Where a quantity is further apart than the larger sigma explains."""
    larger = np.fmax(*sigmas)
    with np.errstate(invalid="ignore"):
        where = off > APART * larger
    for begin, end in _runs(t, where):
        worst = begin + int(np.nanargmax(off[begin : end + 1]))
        most = f"{off[worst]:.3g} {unit} at {t[worst]:.1f} s, {off[worst] / larger[worst]:.1f} sigmas"
        yield Apart(start_s=float(t[begin]), stop_s=float(t[end]), what=name, most=most)


def text(found: Differences) -> str:
    """The differences for a reader at a terminal."""
    return "\n".join(_lines(found))


def _lines(found: Differences) -> Iterator[str]:
    yield f"A: {found.first}"
    yield f"B: {found.second}"
    alone = f"; {found.alone[0]} states of A and {found.alone[1]} of B before or after" if any(found.alone) else ""
    yield f"{found.states} states compared, seconds {found.start_s:.1f} to {found.stop_s:.1f}{alone}"
    yield ""
    rows = [["B less A", "RMS", "95 % below", "max", "unit", "at [s]", "in sigmas: RMS", "max", "at [s]", "sigma B / A"]]
    for name, one in found.quantities.items():
        cells = [f"{one.rms:.3f}", f"{one.p95:.3f}", f"{one.max:.3f}", one.unit, f"{one.max_at_s:.1f}"]
        if one.rms_sigmas is None or one.max_sigmas is None or one.max_sigmas_at_s is None:
            cells += ["-"] * 4
        else:
            ratio = "-" if one.sigma_ratio is None else f"{one.sigma_ratio:.2f}"
            cells += [f"{one.rms_sigmas:.2f}", f"{one.max_sigmas:.1f}", f"{one.max_sigmas_at_s:.1f}", ratio]
        rows.append([f"  {name}", *cells])
    yield from table(rows)
    yield ""
    if not found.apart:
        yield f"nowhere further apart than {APART:g} sigmas, and always in the same mode"
    for stretch in found.apart[:SHOWN]:
        yield f"{stretch.start_s:.1f} to {stretch.stop_s:.1f} s: {stretch.what}: {stretch.most}"
    if len(found.apart) > SHOWN:
        yield f"and {len(found.apart) - SHOWN} more stretches"
