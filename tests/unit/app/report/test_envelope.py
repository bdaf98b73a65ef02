"""Curves in bounded memory keep every peak and every gap."""

from __future__ import annotations

import math

import numpy as np

from fusiond.app.report.envelope import Envelope, Spans
from fusiond.units import SECOND

MS = SECOND // 1000


def test_a_short_curve_is_kept_as_it_is() -> None:
    envelope = Envelope(("a", "b"))
    for k in range(5):
        envelope.add(k * 10 * MS, (float(k), -1.0))
    curves = envelope.curves()
    assert curves["t"].tolist() == [0.0, 0.01, 0.02, 0.03, 0.04]
    assert curves["a"].tolist() == [0, 1, 2, 3, 4] and curves["b"].tolist() == [-1] * 5


def test_a_long_curve_keeps_its_peaks_in_bounded_memory() -> None:
    envelope, many = Envelope(("a", "b"), capacity=100), 50_000
    for k in range(many):
        envelope.add(k * 5 * MS, (1000.0 if k == 31_415 else math.sin(k), -7.0 if k == 27 else 0.0))
    curves = envelope.curves()
    assert 100 < len(curves["t"]) <= 200 and len(envelope) <= 100
    assert curves["a"].max() == 1000.0 and curves["b"].min() == -7.0
    peak = curves["t"][np.argmax(curves["a"])]
    assert abs(peak - 31_415 * 0.005) <= (curves["t"][-1] - curves["t"][0]) / 50
    assert (np.diff(curves["t"]) >= 0).all()
    assert curves["t"][0] == 0.0 and curves["t"][-1] == (many - 1) * 0.005


def test_samples_of_any_order_give_one_curve() -> None:
    forth, back = Envelope(("a",), capacity=30), Envelope(("a",), capacity=30)
    samples = [(k * MS * 20, (float(k * k % 71),)) for k in range(400)]
    for since_ns, values in samples:
        forth.add(since_ns, values)
    for since_ns, values in reversed(samples):
        back.add(since_ns, values)
    assert forth.curves()["a"].tolist() == back.curves()["a"].tolist()
    assert forth.curves()["t"].tolist() == back.curves()["t"].tolist()


def test_an_unknown_value_hides_no_known_one_and_a_gap_is_one() -> None:
    envelope = Envelope(("a",), capacity=40)
    for k in range(1001):
        if not 400 <= k < 600:
            envelope.add(k * 20 * MS, (math.nan if k % 2 else 3.0,))
    curves = envelope.curves()
    known = np.isfinite(curves["a"])
    assert set(curves["a"][known]) == {3.0}
    gap = curves["t"][~known]
    assert len(gap) == 2 and 7.0 < gap[0] < 8.1 and 11.9 < gap[1] < 12.1


def test_stretches_of_one_value_are_one_and_the_shortest_go_first() -> None:
    spans = Spans(capacity=3)
    for second, value in enumerate("aaabccccdd"):
        spans.add(second * SECOND, value, f"note {second}")
    spans.finish(12 * SECOND)
    found = [(span.value, span.start_ns // SECOND, span.stop_ns // SECOND) for span in spans.items]
    assert found == [("a", 0, 4), ("c", 4, 8), ("d", 8, 12)]  # b, a second long, is drawn as a
    assert spans.merged == 1 and spans.items[-1].note == "note 9"
