"""What a section of the configuration declares about its kind of sensor."""

from __future__ import annotations

from typing import NamedTuple

from fusiond.config.toml import Section
from fusiond.events import Payload

INERTIAL = "imu"  # stands for an observation model in the stream that carries the state forward
INPUTS = {"link": "mavlink", "bus": "can"}  # the key by which a sensor names its input: the table of those inputs


class Stream(NamedTuple):
    """One stream of measurements that a sensor gives. The source's name is the sensor's with the suffix."""

    model: str  # the observation model that it feeds, or INERTIAL
    payload: type[Payload]
    delay_ms: float  # how long before its stamp a sample was true; a bus's own delay is added to it
    suffix: str = ""
    enabled: bool = True  # False: the configuration turns the stream off
    correlation_s: float = 0.0  # correlation time of its errors
    sigma: float = 0.0  # configured for one sample, in the unit of the model
    group: str | None = None  # sensors of one group share part of their error
    shared_sigma: float = 0.0  # that part, in the same unit
    noise_min: float = 1.0  # the sigma is learnt, down to this multiple of the configured one
    noise_max: float = 1.0  # and up to this
    outlier_share: float = 0.0  # share of samples that are outliers, weighed by their likelihood; 0: they are gated
    companion: str | None = None  # suffix of another stream of this sensor: this one is trusted only while that one is


class Sensor(Section, frozen=True, kw_only=True):
    """A table [KIND.NAME] that describes a sensor. What the rest of the program must know of the kind, it asks here."""

    def streams(self) -> tuple[Stream, ...]:
        """The streams that it gives."""
        raise NotImplementedError

    def inputs(self) -> dict[str, str]:
        """The inputs that it comes by: the keys of INPUTS that it has, with the names that stand there."""
        names = {key: getattr(self, key, None) for key in INPUTS}
        return {key: name for key, name in names.items() if name is not None}
