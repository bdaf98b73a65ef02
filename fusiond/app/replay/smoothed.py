"""The smoothed track of a replay: collected while it runs, smoothed at its end, written and compared with the truth."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from tempfile import TemporaryFile

import numpy as np

from fusiond.app.replay.comparison import Comparison, Errors, Window, errors_of
from fusiond.app.replay.replay import Replay
from fusiond.app.replay.summary import JudgedSource, SmoothedReport
from fusiond.app.replay.truth import Truth
from fusiond.estimator.archive import Archive, Spool
from fusiond.estimator.smoother import Judged, Smoother
from fusiond.filter.observations import IMU
from fusiond.filter.rows import Outcome
from fusiond.filter.smoothing import USED
from fusiond.messages import StateMessage
from fusiond.messages.from_solution import state_message
from fusiond.messages.types import OutcomeCounts

StateSink = Callable[[StateMessage, Errors | None], None]


class Smoothing:
    """Archives a replay in temporary files, and smooths it at the instants of its states."""

    def __init__(self, sinks: Sequence[StateSink], stack: ExitStack) -> None:
        """Each smoothed state goes to the sinks, with its errors. `stack` closes the temporary files."""
        self._sinks = sinks
        self._spools = [Spool(stack.enter_context(TemporaryFile())) for _ in range(2)]  # noqa: SIM115
        self._instants, self._sigmas = array("q"), array("d")  # of the filter's states
        self._judged: dict[str, JudgedSource] = {}

    def attach(self, replay: Replay) -> None:
        """Archive a replay, which has not begun."""
        self._replay = replay
        self._archive = Archive(replay.fusion.params, self._spools[0])
        replay.fusion.history.archive = self._archive.add

    def add_tick(self, message: StateMessage, _: Errors | None) -> None:
        """Note the instant of a state."""
        state = message.state
        self._instants.append(message.t_ns)
        self._sigmas.append(math.hypot(*state.sigma_position_ned_m[:2]) if state else math.nan)

    def finish(self, truth: Truth | None, window: Window) -> SmoothedReport:
        """Smooth, when the replay is done, and compare with the truth in a window."""
        fusion, engine = self._replay.fusion, self._replay.engine
        fusion.history.finish()
        self._archive.finish()
        instants = np.unique(np.frombuffer(self._instants, dtype=np.int64))
        smoother = Smoother(self._archive, instants, spool=self._spools[1])
        smoother.smooth(self._judge)
        comparison, states, squares, vehicle = Comparison(window), 0, 0.0, self._replay.config.vehicle.name
        seen = set[int]()
        for solution in smoother.solutions():
            message = state_message(solution, vehicle, OutcomeCounts())
            errors = errors_of(message, truth.at(message.t_ns)) if truth else None
            if errors:
                comparison.add(message.t_ns - engine.origin_ns, errors)
            if message.state:
                states += 1
                seen.add(message.t_ns)
                squares += sum(sigma * sigma for sigma in message.state.sigma_position_ned_m[:2])
            for sink in self._sinks:
                sink(message, errors)
        return SmoothedReport(
            states=states,
            runs=len(smoother.runs),
            lost=sum(run.lost for run in smoother.runs),
            sigma_m=math.sqrt(squares / states) if states else None,
            filter_sigma_m=self._filter_sigma(seen),
            sources={name: self._judged[name] for name in fusion.params.sources if name in self._judged},
            truth=comparison.report(),
        )

    def _filter_sigma(self, seen: set[int]) -> float | None:
        """Of the filter's states at the instants that were smoothed too."""
        both = zip(self._instants, self._sigmas, strict=True)
        squares = [sigma * sigma for t_ns, sigma in both if t_ns in seen and math.isfinite(sigma)]
        return math.sqrt(sum(squares) / len(squares)) if squares else None

    def _judge(self, judged: Judged) -> None:
        """Count the verdicts on measurements: of a fix the horizontal one."""
        params = self._archive.params
        for source in np.unique(judged.rows["source"]).tolist():
            if params.models[source] == IMU:
                continue
            at = judged.rows["source"] == source
            used, fused = judged.verdicts[at, 0] == USED, judged.rows["outcome"][at] == Outcome.FUSED
            found = self._judged.setdefault(params.sources[source], JudgedSource())
            found.used += int(used.sum())
            found.left_out += int((~used).sum())
            found.dropped += int((~used & fused).sum())
            found.taken_back += int((used & ~fused).sum())
