"""What a section of the configuration declares about its kind of sensor."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, NamedTuple

from fusiond.config.toml import Section
from fusiond.events import Payload, Vector3

INERTIAL = "imu"  # stands for an observation model in the stream that carries the state forward
INPUTS = {"link": "mavlink", "bus": "can"}  # the key by which a sensor names its input: the table of those inputs


class Stream(NamedTuple):
    """One stream of measurements that a sensor gives. The source's name is the sensor's with the suffix."""

    model: str  # the observation model that it feeds, or INERTIAL
    payload: type[Payload]
    delay_ms: float  # how long before its stamp a sample was measured; the delay of its bus is added
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

    label: ClassVar[str]  # the kind in words, at most 12 characters
    required: ClassVar[bool] = False  # exactly one is needed
    only_one: ClassVar[str | None] = None  # why there can be one at most
    point: ClassVar[str | None] = None  # the key of the sensor's position from the IMU [m]
    live: ClassVar[frozenset[str]] = frozenset({"rate_hz", "interval_s"})  # a running daemon can take new values of these

    def streams(self) -> tuple[Stream, ...]:
        """The streams that it gives."""
        raise NotImplementedError

    def messages(self) -> dict[str, float]:
        """The messages of its link or bus that it reads, each with the rate [Hz] to ask for; 0 on a bus."""
        raise NotImplementedError

    def origin(self) -> str:
        """What it reads, in words. Two sensors of one kind must not read the same."""
        return f"{', '.join(self.messages())} of {', '.join(self.inputs().values())}"

    def description(self, name: str) -> Iterator[str]:
        """What it will do, in words; the first line follows the label and the name."""
        raise NotImplementedError

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Keys that cannot stand together: the key ("" for the whole table), and what is wrong."""
        return iter(())

    def inputs(self) -> dict[str, str]:
        """The inputs that it comes by: the keys of INPUTS that it has, with the names that stand there."""
        names = {key: getattr(self, key, None) for key in INPUTS}
        return {key: name for key, name in names.items() if name is not None}


def vector_in_words(vector: Vector3) -> str:
    return " ".join(f"{value:g}" for value in vector)


def point_in_words(point_m: Vector3) -> str:
    return f"{vector_in_words(point_m)} m (forward, right, down)"


def delay_in_words(delay_ms: float) -> str:
    return f"delay {delay_ms:g} ms" if delay_ms else "no delay"
