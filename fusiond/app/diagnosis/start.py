"""Why there is no state, where there is none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fusiond.app.diagnosis.evidence import Evidence
from fusiond.app.diagnosis.finding import Finding
from fusiond.app.replay.summary import SourceReport


def start_findings(evidence: Evidence, sources: Mapping[str, SourceReport]) -> Iterator[Finding]:
    """The reason for a filter that has not started although the inertial sensor came."""
    config = evidence.config
    fixes = sum(len(one) for one in evidence.positions.values())
    if not config.gnss:
        yield _none("no_gnss", "no [gnss.NAME] is configured: without a position the filter never starts", "gnss")
        return
    (first, *_) = config.gnss
    if not fixes:
        events = sum(sources[f"{name}.position"].events for name in config.gnss)
        yield _none(
            "no_position", f"none of {events} fixes could be used, so no position is known", f"gnss.{first}.minimum_fix_type"
        )
        return
    speeds = [np.hypot(*one.arrays()[1].T) for one in evidence.velocities.values() if len(one)]
    if not speeds:
        extent = max(float(np.hypot(*np.ptp(one.arrays()[1], axis=0))) for one in evidence.positions.values() if len(one))
        words = f"heading unknown: the {fixes} fixes have no velocity and lie within {extent:.1f} m; give heading_deg"
        yield _none("no_heading", words, "filter.heading_deg")
        return
    fastest = max(float(one.max()) for one in speeds)
    limit = config.filter.course_speed_mps
    words = f"heading unknown: by GNSS never faster than {fastest:.1f} m/s"
    more = f", and only above course_speed_mps ({limit:g} m/s) the course is the heading at once" if fastest < limit else ""
    yield _none("no_heading", f"{words}{more}; give heading_deg, or drive longer", "filter.heading_deg")


def _none(kind: str, text: str, key: str) -> Finding:
    return Finding(kind=kind, weight="no_state", text=text, key=key)
