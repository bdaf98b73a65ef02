"""What a batch tells of one drive: a row, whatever happened to the drive."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

from fusiond.app.replay.outages import Outage

LAYOUT = 1  # raised when a column is removed or changes its meaning: rows of another layout are made anew

Status = Literal["ok", "failed", "timed out", "out of memory", "crashed"]


class SourceRow(Struct, frozen=True, kw_only=True):
    """One source of measurements over the drive."""

    name: str
    events: int
    fused: int
    rejected: int
    too_old: int
    invalid: int
    latency_p50_ms: float | None  # receipt less the instant measured; None if no event was usable
    latency_p99_ms: float | None
    status: str  # the likeliest condition at the end: nominal, noisy, biased, frozen, absent
    remark: str  # what is wrong with it, if that is known


class FindingRow(Struct, frozen=True, kw_only=True):
    """What the data say against the configuration, as `fusiond doctor` does."""

    kind: str
    weight: str  # no_state, contradiction or note
    text: str
    key: str  # of the configuration to change; empty: none would help


class CalibrationRow(Struct, frozen=True, kw_only=True):
    """What was learnt of the installation: a correction to the configured value, in the unit that its name ends in."""

    name: str
    value: float
    sigma: float


class Row(Struct, frozen=True, kw_only=True):
    """One drive by one configuration. What is not known is None; of a drive that is not ok only the reason is known."""

    status: Status
    reason: str = ""  # why it is not ok
    fusiond: str  # version
    config: str  # name of the configuration's file
    vehicle: str = ""
    logs: list[str] = []  # names of the files
    size: int = 0  # of all files [bytes]
    seconds: float | None = None
    distance_m: float | None = None
    events: int = 0
    warnings: list[str] = []
    # Accuracy: errors of the published states against the reference
    reference: Literal["", "truth", "smoother"] = ""  # the truth or, with --smooth, where there is none the smoothed track
    position_rmse_m: float | None = None  # horizontal
    position_p95_m: float | None = None
    position_max_m: float | None = None
    position_end_m: float | None = None
    inside_95: float | None = None  # share of states whose error lies in their 95 % ellipse
    nees: float | None = None  # mean squared horizontal error in units of the covariance; 2 is honest
    height_rmse_m: float | None = None
    velocity_rmse_mps: float | None = None  # horizontal
    heading_rmse_deg: float | None = None  # mean offset removed
    # Outages: GNSS withheld again and again in a second replay; errors against the truth, or without one the first replay
    outages: list[Outage] = []
    outage_68_percent: float | None = None  # 68 % of the errors are at most this share of the distance [%]
    outage_max_percent: float | None = None
    # Health
    states: int = 0  # published
    aligning: float | None = None  # share of the published states in this mode; the four sum to 1
    nominal: float | None = None
    dead_reckoning: float | None = None
    lost: float | None = None
    resets: int = 0
    latency_p99_ms: float | None = None  # of the latest source
    sources: list[SourceRow] = []
    calibration: list[CalibrationRow] = []
    findings: list[FindingRow] = []
    track: str = ""  # name of the file of the track, if one was asked for
