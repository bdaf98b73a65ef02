"""What came of each source, and why nothing came of it: messages, senders, fixes, lateness, logs of other days."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set

from fusiond.app.diagnosis.finding import Finding, Weight
from fusiond.app.replay.summary import SourceReport
from fusiond.config.schema import Config, Source
from fusiond.config.sensor import INPUTS
from fusiond.filter.observations import IMU
from fusiond.filter.parameters import model_of
from fusiond_adapters.logs.census import Sent

MOST = 0.5  # a source of which more is lost is of little use
REASON_KEYS = {  # of a reading that is invalid: the key that makes it so
    "beyond accel_limit": "accel_limit",
    "beyond gyro_limit": "gyro_limit",
    "valid_signal": "valid_value",
    "stale counter": "counter_signal",
    "checksum": "checksum",
    "not available": "not_available_from",
    "no fix": "minimum_fix_type",
}
SHOWN = 4  # messages of a sender that are listed


def input_findings(
    config: Config,
    sources: Mapping[str, SourceReport],
    sent: list[Sent],
    counts: Mapping[str, int],
    protocols: Set[str],
) -> Iterator[Finding]:
    """What is missing or of no use. `sent`: the messages of the .tlogs; `counts`: those of the readers over all logs;
    `protocols`: of which there is a log."""
    streams = config.streams()
    told: set[str] = set()
    for name, report in sources.items():
        source = streams[name]
        sensor = f"{source.table}.{source.name}"
        without_log = [
            f"{table}.{source.section.inputs()[key]}"
            for key, table in INPUTS.items()
            if key in source.section.inputs() and table not in protocols
        ]
        if without_log:
            (where,) = without_log
            if where not in told:
                told.add(where)
                yield Finding(
                    kind="no_log",
                    weight="note",
                    text=f"no log of {where} is given, so {source.name} and its like are missing",
                )
            continue
        if report.withheld or not source.stream.enabled or sensor in told:
            continue
        if not report.events:
            if source.stream.suffix != ".velocity":  # that has a finding of its own
                told.add(sensor)
                yield _missing(config, sensor, source, sent, counts)
        elif report.invalid > MOST * report.events:
            told.add(sensor)
            yield _invalid(sensor, name, report)
        elif report.too_old > MOST * report.events:
            told.add(sensor)
            yield _too_old(sensor, name, report, config)


def _missing(config: Config, sensor: str, source: Source, sent: list[Sent], counts: Mapping[str, int]) -> Finding:
    weight: Weight = "no_state" if model_of(source.stream) == IMU else "contradiction"
    link = source.section.inputs().get("link")
    wanted = " or ".join(source.section.messages())
    if link is None:
        ids = counts.get("other ids", 0)
        words = (
            f"{source.name} wants {wanted} on a CAN bus, and none of {ids} other frames has its id: are DBC and log right?"
        )
        bus = source.section.inputs().get("bus", "")
        return Finding(kind="missing", weight=weight, text=words, key=f"can.{bus}.dbc" if ids else f"{sensor}.bus")
    given = config.mavlink[link]
    have = [one for one in sent if one.message in source.section.messages()]
    if given.system and have and all(one.system != given.system for one in have):
        systems = ", ".join(str(system) for system in sorted({one.system for one in have}))
        words = f"{source.name} wants {wanted} of system {given.system}; in this log it comes from system {systems}"
        return Finding(kind="system", weight=weight, text=words, key=f"mavlink.{link}.system", value=systems.split(", ")[0])
    if given.component and have and all(one.component != given.component for one in have):
        components = ", ".join(str(one) for one in sorted({one.component for one in have}))
        words = (
            f"{source.name} wants {wanted} of component {given.component}; in this log it comes from component {components}"
        )
        return Finding(kind="component", weight=weight, text=words, key=f"mavlink.{link}.component", value="0")
    others = [one for one in sent if one.message in ALIKE.get(type(source.section).__name__, ())]
    if others:
        listed = ", ".join(f"{one.message} at {one.rate_hz:.3g} Hz from system {one.system}" for one in others[:SHOWN])
        words = f"{source.name} wants {wanted}; this log has {listed}"
        return Finding(kind="message", weight=weight, text=words, key=f"{sensor}.message", value=f'"{others[0].message}"')
    listed = ", ".join(f"{one.message} at {one.rate_hz:.3g} Hz" for one in sent[:SHOWN]) or "no MAVLink"
    words = f"{source.name} wants {wanted}; nothing of its kind is in the log, which has {listed}"
    return Finding(kind="missing", weight=weight, text=words, key=f"{sensor}.message" if sent else f"{sensor}.link")


ALIKE = {  # messages that a kind of sensor can read
    "Imu": ("HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU"),
    "Gnss": ("GPS_RAW_INT", "GPS2_RAW"),
    "DualAntenna": ("GPS_RAW_INT", "GPS2_RAW"),
    "Barometer": ("SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3"),
    "Wheel": ("WHEEL_DISTANCE",),
}


def _invalid(sensor: str, name: str, report: SourceReport) -> Finding:
    reason = max(report.invalid_reasons, key=lambda one: report.invalid_reasons[one])
    key = next((key for begin, key in REASON_KEYS.items() if reason.startswith(begin)), "message")
    return Finding(
        kind="invalid",
        text=f"{name}: {report.invalid} of {report.events} readings are invalid: {reason}",
        key=f"{sensor}.{key}",
    )


def _too_old(sensor: str, name: str, report: SourceReport, config: Config) -> Finding:
    late = report.lateness.late_s if report.lateness else 0.0
    beyond = report.lateness.beyond_s if report.lateness else 0.0
    short = late < 10 * config.filter.horizon_s
    return Finding(
        kind="too_old",
        text=f"{name}: {report.too_old} of {report.events} readings came later than the {config.filter.horizon_s:g} s of "
        f"filter.horizon_s, by up to {beyond:.2g} s" + ("" if short else ": is its delay or its stamp right?"),
        key="filter.horizon_s" if short else f"{sensor}.delay_ms",
        value=f"{1.5 * late:.2g}" if short else "",
    )
