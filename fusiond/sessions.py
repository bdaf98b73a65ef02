"""Sessions: where receipt stamps step back, the host's clock was set back or another drive follows, and a time line begins.

Receipts of different sources overtake each other a little: threads, channels and files are read in turn. The receipts of
one source do not: the host stamped them as they came. So a step back shows in a source's own receipts.
"""

from __future__ import annotations

from fusiond.units import MILLISECOND, SECOND

STEP_BACK_NS = 100 * MILLISECOND  # of one source's receipts; a clock that is disciplined slews what is less
DISORDER_NS = SECOND  # of different sources' receipts; only a step back is more

NEVER = -(2**62)


class Receipts:
    """The receipts of a session so far."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}  # by source
        self._latest = NEVER  # of all

    def steps_back(self, source: str, t_receive_ns: int) -> bool:
        """Whether a receipt shows that the stamps have stepped back: that it begins a new session."""
        if t_receive_ns >= self._latest:
            return False
        last = self._last.get(source)
        if last is None:
            return t_receive_ns < self._latest - DISORDER_NS
        return t_receive_ns < last - STEP_BACK_NS

    def add(self, source: str, t_receive_ns: int) -> None:
        """Add a receipt that does not step back."""
        if t_receive_ns > self._last.get(source, NEVER):
            self._last[source] = t_receive_ns
            if t_receive_ns > self._latest:
                self._latest = t_receive_ns

    def clear(self) -> None:
        """Begin a new session."""
        self._last.clear()
        self._latest = NEVER
