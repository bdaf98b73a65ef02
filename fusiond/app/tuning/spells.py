"""How well a configuration bridges spells without GNSS: the errors at their ends, against the sigmas that were claimed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from msgspec import Struct

from fusiond.app.tuning.series import LogSeries
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.estimator.solution import SolutionState
from fusiond.events import GnssPosition, GnssVelocity, Measurement
from fusiond.maths.rotation import matrix
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import radii

SHORTEST_S, LONGEST_S = 10.0, 60.0
SPELLS = 12  # wanted of a half
MOST_NEES = 100.0  # one spell counts for at most this in the score: a single wrong fix decides nothing


class Score(Struct, frozen=True, kw_only=True):
    """Errors at the ends of spells without GNSS, against the fixes that were withheld."""

    spells: int
    length_s: float
    rmse_m: float  # horizontal
    nees: float  # mean squared error by the covariance of state and fix: 2 if that is honest
    each: list[float]  # log-likelihood of each error, larger is better


def is_better(one: Score, other: Score) -> bool:
    """Whether the errors of one are likelier than those of the other, spell by spell, by more than chance: one standard
    error of the mean difference."""
    if len(one.each) != len(other.each):
        return len(one.each) > len(other.each)  # the other had no state at some ends
    gained = np.subtract(one.each, other.each)
    return bool(gained.mean() > gained.std() / math.sqrt(len(gained)))


class _End(NamedTuple):
    off: Array  # (2,) m
    covariance: Array  # (2, 2)


def length_for(seconds: float) -> float:
    """A length of spells for a stretch of so many seconds."""
    return min(LONGEST_S, max(SHORTEST_S, seconds / (2 * SPELLS)))


def score(config: Config, log: LogSeries, begin_s: float, end_s: float, length_s: float) -> Score | None:
    """Replay with GNSS withheld in every second spell between two instants, and again with the others withheld: the errors
    at their ends. None where there is no end to look at."""
    ends = [end for phase in (0, 1) for end in _ends(config, log, begin_s, end_s, length_s, phase)]
    if not ends:
        return None
    nees = np.array([float(end.off @ np.linalg.solve(end.covariance, end.off)) for end in ends])
    sizes = np.array([math.log(float(np.linalg.det(end.covariance))) for end in ends])
    return Score(
        spells=len(ends),
        length_s=length_s,
        rmse_m=math.sqrt(float(np.mean([float(end.off @ end.off) for end in ends]))),
        nees=float(nees.mean()),
        each=(-(np.minimum(nees, MOST_NEES) + sizes) / 2).tolist(),
    )


def _ends(config: Config, log: LogSeries, begin_s: float, end_s: float, length_s: float, phase: int) -> list[_End]:
    """The ends of every second spell, of those with a state."""
    fusion, ends = Fusion(config), list[_End]()
    last: Measurement | None = None  # withheld fix
    within = -1
    for event in log.under(config):
        if isinstance(event.payload, GnssPosition | GnssVelocity):
            since = (event.t_ns - log.origin_ns) * 1e-9
            spell = int((since - begin_s) // length_s) if begin_s <= since < end_s else -1
            if within >= 0 and spell != within:
                if last is not None and (end := _end(config, fusion, last)) is not None:
                    ends.append(end)
                last, within = None, -1
            whole = begin_s + (spell + 1) * length_s <= end_s
            if spell >= 0 and spell % 2 == phase and whole:
                within = spell
                if isinstance(event.payload, GnssPosition):
                    last = event
                continue
        fusion.fuse(event)
    return ends


def _end(config: Config, fusion: Fusion, fix: Measurement) -> _End | None:
    """How far the state is off the last withheld fix. It has come a little further: it goes back along its velocity."""
    head = fusion.history.applied_ns
    state = fusion.solution_at(head).state
    payload = fix.payload
    if state is None or not isinstance(payload, GnssPosition):
        return None
    receiver = config.gnss[fix.source.partition(".")[0]]
    back = (head - fix.t_ns) * 1e-9
    if not 0 <= back < 2.0:
        return None
    off = _off(state, payload, np.array(receiver.lever_arm_m)) + np.array(state.velocity_n[:2]) * back
    sigma = max(payload.sigma_horizontal or 0.0, receiver.sigmas(payload.fix_type)[0])
    return _End(off, state.covariance[:2, :2] + np.eye(2) * sigma**2)


def _off(state: SolutionState, fix: GnssPosition, lever_b: Array) -> Array:
    """Fix less antenna (2,), north and east [m]."""
    meridian, transverse = radii(state.latitude)
    lever = matrix(np.array(state.quaternion_nb)) @ lever_b
    north = (fix.latitude - state.latitude) * (meridian + state.height) - lever[0]
    turned = (fix.longitude - state.longitude + math.pi) % (2 * math.pi) - math.pi
    return np.array([north, turned * (transverse + state.height) * math.cos(state.latitude) - lever[1]])
