"""What the filter came to believe: sources that it rejects, noise that it was told wrongly, gates that reject nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from fusiond.app.diagnosis.evidence import Evidence
from fusiond.app.diagnosis.finding import Finding
from fusiond.app.diagnosis.fits import MIN_READINGS, SURE
from fusiond.app.diagnosis.wheels import MOVING, motion_by_gnss
from fusiond.app.replay.summary import SourceReport
from fusiond.config.schema import Source
from fusiond.estimator.fusion import Fusion
from fusiond.filter.calibration import calibrations, first_sigmas
from fusiond.filter.observations import GNSS_POSITION, GNSS_VELOCITY, GNSS_YAW, WHEEL_SPEED
from fusiond.filter.parameters import model_of
from fusiond.filter.source_health import misreading
from fusiond.maths.statistics import chi_square

AXES = {GNSS_POSITION: 2, GNSS_VELOCITY: 2, GNSS_YAW: 1, WHEEL_SPEED: 1}
SIGMA_KEYS = {"gnss_position": "position_sigma_m", "gnss_velocity": "velocity_sigma_mps", "wheel_speed": "sigma_mps",
              "gnss_yaw": "sigma_deg", "barometric_height": "sigma_m"}  # fmt: skip
FAR_M = 50.0  # a track that is shorter says little of how wide a gate of positions is


def belief_findings(evidence: Evidence, fusion: Fusion, sources: Mapping[str, SourceReport]) -> Iterator[Finding]:
    """What is wrong by the filter's own beliefs. These are symptoms: a cause that was found explains them."""
    streams = evidence.config.streams()
    for name, report in sources.items():
        source = streams[name]
        if report.rejected > report.fused:
            words = misreading(fusion.history.head.memory[fusion.history.index[name]])
            share = 100 * report.rejected / (report.rejected + report.fused)
            yield Finding(
                kind="rejected",
                text=f"{name}: {share:.0f} % of its {report.rejected + report.fused} readings contradict the rest"
                + (f": {words}" if words else ""),
                key=f"{source.table}.{source.name}.{SIGMA_KEYS.get(source.stream.model, 'message')}",
            )
        else:
            yield from _noise(evidence, fusion, name, source)
    yield from _learnt(fusion)
    yield from _gates(evidence, fusion)


def _learnt(fusion: Fusion) -> Iterator[Finding]:
    """Calibrations that were learnt far from what the configuration allows them."""
    params, head = fusion.params, fusion.history.head
    (imu,) = fusion.config.imu
    first = first_sigmas(params)
    for name, (value, sigma) in calibrations(params, head).items():
        prior = first[name]
        if name != "height_offset_m" and abs(value) > SURE * prior and abs(value) > SURE * sigma:
            key = next(
                (key for begin, key in CALIBRATION_KEYS.items() if name.startswith(begin)), "filter.wheel_scale_sigma"
            )
            yield Finding(
                kind="calibration",
                text=f"{name} was learnt as {value:.3g} +- {sigma:.2g}, {abs(value) / prior:.0f} times its initial sigma",
                key=key.format(imu=imu, gnss=next(iter(fusion.config.gnss), "")),
            )


CALIBRATION_KEYS = {
    "mount": "imu.{imu}.rotation_deg",
    "lever_arm": "gnss.{gnss}.lever_arm_m",
    "delay": "gnss.{gnss}.delay_ms",
    "velocity_delay": "gnss.{gnss}.velocity_delay_ms",
    "gyro_delay": "imu.{imu}.delay_ms",
    "accel_delay": "imu.{imu}.delay_ms",
    "slip": "motion.slip_sigma_deg_per_mps2",
}


def _noise(evidence: Evidence, fusion: Fusion, name: str, source: Source) -> Iterator[Finding]:
    """Innovations that are much larger than configured, even where the noise was learnt up to its bound."""
    expected = evidence.expected.get(name)
    axes = AXES.get(model_of(source.stream))
    if expected is None or axes is None or expected.readings < MIN_READINGS:
        return
    usual = float(np.median(expected.ratios)) * fusion.params.gates[axes] / chi_square(0.5, axes)
    if usual > NOISY_NIS:
        key = SIGMA_KEYS[source.stream.model]
        yield Finding(
            kind="sigma",
            text=f"{name}: its squared innovations are {usual:.1f} times as large as the filter expects, in the "
            f"median of {expected.readings} readings: is its sigma too small?",
            key=f"{source.table}.{source.name}.{key}",
        )


NOISY_NIS = 4.0  # median of the normalised innovations squared, over that of chi-square; 1 is right


def _gates(evidence: Evidence, fusion: Fusion) -> Iterator[Finding]:
    """Gates so wide that no reading of this drive could have been rejected: a wheel that reads 0, a fix that stays where the
    drive began."""
    streams = evidence.config.streams()
    motion = motion_by_gnss(evidence)
    if motion is None or float(motion.speed.max()) < MOVING:
        return
    fastest = float(motion.speed.max())
    for name, expected in evidence.expected.items():
        source = streams[name]
        axes = AXES.get(model_of(source.stream))
        if axes is None or expected.readings < MIN_READINGS:
            continue
        half = math.sqrt(fusion.params.gates[axes]) * float(np.median(expected.sigmas))
        reach, words = _reach(evidence, model_of(source.stream), source.name, fastest)
        if half > reach > 0:
            yield Finding(
                kind="gate",
                text=f"{name}: its gate could not have rejected anything: it is +- {words.format(half)}, and no reading of "
                f"this drive can be off by more than {words.format(reach)}; is its sigma too large?",
                key=f"{source.table}.{source.name}.{SIGMA_KEYS[source.stream.model]}",
            )


def _reach(evidence: Evidence, model: int, name: str, fastest: float) -> tuple[float, str]:
    """The most that a reading can be off if it stays what it was at any other instant, and how it is written."""
    if model == GNSS_POSITION:
        _, places = evidence.positions[name].arrays()
        size = float(np.hypot(*np.ptp(places, axis=0))) if len(places) else 0.0
        return (size if size > FAR_M else 0.0), "{:.0f} m"
    if model == GNSS_YAW:
        return math.pi, "{:.2f} rad"
    return fastest, "{:.1f} m/s"
