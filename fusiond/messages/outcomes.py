"""Published outcomes: their names and counts."""

from __future__ import annotations

from collections.abc import Sequence

from fusiond.estimator.fusion import Fusion
from fusiond.filter.rows import Outcome
from fusiond.messages.types import OutcomeCounts, OutcomeName

NAMES: dict[Outcome, OutcomeName] = {
    Outcome.FUSED: "fused",
    Outcome.REJECTED: "rejected",
    Outcome.TOO_OLD: "too_old",
    Outcome.DUPLICATE: "duplicate",
    Outcome.INVALID: "invalid",
    Outcome.WAITING: "waiting",
    Outcome.GATHERED: "gathered",
}


def outcome_counts(counts: Sequence[int]) -> OutcomeCounts:
    """The message of one row of `History.counts`."""
    return OutcomeCounts(**{name: counts[outcome] for outcome, name in NAMES.items()})


def totals(fusion: Fusion) -> OutcomeCounts:
    """Counts of outcomes over all sources."""
    return outcome_counts(fusion.history.counts.sum(axis=0).tolist())
