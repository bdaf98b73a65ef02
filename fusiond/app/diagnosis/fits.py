"""Straight lines through readings: least squares that outliers do not bend, with sigmas that allow for errors that last."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusiond.maths.typed import Array

MIN_READINGS = 20
ROUNDS, TRIM = 3, 4.0  # of leaving out what is beyond so many sigmas
MAX_CORRELATION = 0.95
SURE = 5.0  # sigmas: what is off by more is no chance


class Fit(NamedTuple):
    """measured = columns @ values + rest."""

    values: Array  # (n,)
    sigmas: Array  # (n,)
    rest: float  # root mean square of what is not explained, of the readings that were kept
    explained: float  # share of the variance of all readings that the columns explain, 0 to 1
    readings: int


def fit(columns: list[Array], measured: Array) -> Fit | None:
    """Least squares of readings (K,) on columns, each (K,); None where they are too few or the columns alike. Readings that
    are not finite are left out."""
    design = np.stack(columns, axis=1)
    known = np.isfinite(measured) & np.isfinite(design).all(axis=1)
    design, measured = design[known], measured[known]
    kept = np.ones(len(measured), dtype=bool)
    for _ in range(ROUNDS):
        if kept.sum() < max(MIN_READINGS, 2 * design.shape[1]) or np.linalg.matrix_rank(design[kept]) < design.shape[1]:
            return None
        values = np.asarray(np.linalg.lstsq(design[kept], measured[kept], rcond=None)[0], np.float64)
        off = measured - design @ values
        limit = TRIM * 1.4826 * float(np.median(np.abs(off[kept])))
        kept = np.abs(off) <= max(limit, 1e-9)
    rest = off[kept]
    total = float(rest @ rest)
    correlation = min(max(float(rest[1:] @ rest[:-1]) / max(total, 1e-30), 0.0), MAX_CORRELATION)
    variance = total / max(1, len(rest) - len(values)) * (1 + correlation) / (1 - correlation)
    covariance = np.linalg.pinv(design[kept].T @ design[kept]) * variance
    whole = float(np.var(measured))
    return Fit(
        values,
        np.sqrt(np.diag(covariance)),
        math.sqrt(total / len(rest)),
        1 - min(1.0, float(off @ off) / len(off) / whole) if whole > 0 else 0.0,
        len(rest),
    )


class Lag(NamedTuple):
    """By how much one signal lags behind another."""

    lag: float  # s
    sigma: float  # s


REACH, STEP = 2.0, 0.025  # s: lags that are tried


def lag_between(t: Array, signal: Array, t_other: Array, other: Array) -> Lag | None:
    """By how much `signal` (K,) at times `t` [s] lags behind `other` (J,) at `t_other`, of which it is a multiple with an
    offset; None where that does not show. The sigma is that of the best of several lags, by the misfit's curvature."""
    inside = (t > t_other[0] + REACH) & (t < t_other[-1] - REACH) & np.isfinite(signal)
    if inside.sum() < MIN_READINGS:
        return None
    t, signal = t[inside], signal[inside] - float(np.mean(signal[inside]))
    lags = np.arange(-REACH, REACH + STEP / 2, STEP)
    misfits = np.array([_misfit(t - lag, signal, t_other, other) for lag in lags])
    best = int(np.argmin(misfits))
    whole = float(signal @ signal)
    if not 0 < best < len(lags) - 1 or misfits[best] > whole / 2:
        return None
    before, here, after = misfits[best - 1 : best + 2]
    curvature = (before - 2 * here + after) / STEP**2
    if curvature <= 0:
        return None
    lag = float(lags[best]) + STEP / 2 * float(before - after) / max(float(before - 2 * here + after), 1e-30)
    readings = max(1, len(t) - 3)
    return Lag(lag, math.sqrt(2 * float(here) / readings / float(curvature)) * math.sqrt(CORRELATED))


CORRELATED = 4.0  # neighbouring errors that are alike


def _misfit(t: Array, signal: Array, t_other: Array, other: Array) -> float:
    """Sum of squares that a multiple of the other signal leaves."""
    shifted = np.interp(t, t_other, other)
    shifted = shifted - float(np.mean(shifted))
    size = float(shifted @ shifted)
    gain = float(shifted @ signal) / size if size > 0 else 0.0
    rest = signal - gain * shifted
    return float(rest @ rest)
