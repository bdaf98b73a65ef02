"""The diagnosis of a replay: all findings, causes first; symptoms only where no cause was found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

from msgspec.structs import replace

from fusiond.app.diagnosis.beliefs import belief_findings
from fusiond.app.diagnosis.evidence import Evidence
from fusiond.app.diagnosis.finding import Finding
from fusiond.app.diagnosis.inertial import inertial_findings
from fusiond.app.diagnosis.inputs import input_findings
from fusiond.app.diagnosis.receiver import receiver_findings, velocity_findings
from fusiond.app.diagnosis.start import start_findings
from fusiond.app.diagnosis.wheels import wheel_findings
from fusiond.app.replay.summary import SourceReport
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond_adapters.logs.census import Sent, census
from fusiond_adapters.logs.merge import LogSet

HOUR_S, DAY_S = 3600.0, 86400.0


def missing(config: Config, sources: Mapping[str, SourceReport], logs: LogSet) -> list[Finding]:
    """Why nothing came of sources that did not come, from the logs themselves."""
    counts: Counter[str] = Counter()
    for one in logs.counts.values():
        counts.update(one)
    silent = any(not report.events and not report.withheld for report in sources.values())
    sent: list[Sent] = [one for path in logs.counts if silent and ".tlog" in path for one in census(path)]
    return [*_apart(logs), *input_findings(config, sources, sent, counts, logs.protocols)]


def diagnose(
    evidence: Evidence, fusion: Fusion, sources: Mapping[str, SourceReport], logs: LogSet, *, has_state: bool
) -> list[Finding]:
    """All findings of a replay. `has_state`: whether it ended with one."""
    causes = missing(evidence.config, sources, logs)
    causes += [*inertial_findings(evidence), *velocity_findings(evidence)]
    if not any(one.kind == "gnss_velocity" for one in causes):  # by which the others are judged
        causes += [*wheel_findings(evidence), *receiver_findings(evidence)]
    if not has_state:
        grave = [one for one in causes if one.weight != "note" or one.kind == "no_log"]
        without = grave[:1] or list(start_findings(evidence, sources))
        rest = [one for one in causes if one not in without]
        return [*(replace(one, weight="no_state") for one in without), *rest]
    if any(one.weight != "note" for one in causes):
        return causes
    return [*causes, *belief_findings(evidence, fusion, sources)]


def _apart(logs: LogSet) -> Iterator[Finding]:
    """Logs of different days, or of clocks that do not agree."""
    if logs.apart_s:
        far = logs.apart_s
        size = f"{far / DAY_S:.1f} days" if far > DAY_S else f"{far / HOUR_S:.1f} hours" if far > HOUR_S else f"{far:.0f} s"
        yield Finding(
            kind="logs_apart",
            text=f"the MAVLink and the CAN logs lie {size} apart: are they of one drive, and stamped by one clock?",
        )
