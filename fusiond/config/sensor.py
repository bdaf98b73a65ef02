"""What a section of the configuration declares about its kind of sensor."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from typing import Annotated, ClassVar, NamedTuple

from msgspec import Meta

from fusiond.config.toml import Section
from fusiond.events import Payload, Vector3

INERTIAL = "imu"  # in place of an observation model: the stream that propagates the state
INPUTS = {"link": "mavlink", "bus": "can"}  # the key by which a sensor names its input: the table of those inputs

Signal = Annotated[str, Meta(pattern=r"^[^.]+\.[^.]+$", description="a signal of the DBC, written MESSAGE.SIGNAL")]


class Stream(NamedTuple):
    """One stream of measurements of a sensor. The name of the source is that of the sensor with the suffix."""

    model: str  # name of its observation model, or INERTIAL
    payload: type[Payload]
    delay_ms: float  # time from the measurement to the stamp; the delay of the bus is added
    suffix: str = ""
    enabled: bool = True  # False: the configuration turns the stream off
    correlation_s: float = 0.0  # correlation time of its errors
    sigma: float = 0.0  # configured for one sample, in the unit of the model
    group: str | None = None  # sensors of one group have part of their error in common
    shared_sigma: float = 0.0  # that part, in the same unit
    noise_min: float = 1.0  # the sigma is learnt, down to this multiple of the configured one
    noise_max: float = 1.0  # and up to this
    outlier_share: float = 0.0  # share of outliers, which are weighted by their likelihood; 0: outliers are gated
    companion: str | None = None  # suffix of another stream of this sensor: this one is trusted only while that one is


class Sensor(Section, frozen=True, kw_only=True):
    """A table [KIND.NAME] that describes a sensor: its keys, and what the rest of the program needs to know of its kind.

    Every kind defines the methods marked abstract; a test checks that it does.
    """

    label: ClassVar[str]  # the kind in words, at most 12 characters
    required: ClassVar[bool] = False  # exactly one is needed
    only_one: ClassVar[str | None] = None  # why there can be at most one
    point: ClassVar[str | None] = None  # the key of the sensor's position from the IMU [m]
    live: ClassVar[frozenset[str]] = frozenset({"rate_hz", "interval_s"})  # keys that a running daemon can change

    @abstractmethod
    def streams(self) -> tuple[Stream, ...]:
        """The streams that it gives."""

    @abstractmethod
    def messages(self) -> dict[str, float]:
        """The messages of its link or bus that it reads, each with the rate [Hz] to request; 0 on a bus."""

    def origin(self) -> str:
        """What it reads, in words. Two sensors of one kind must not read the same."""
        return f"{', '.join(self.messages())} of {', '.join(self.inputs().values())}"

    @abstractmethod
    def description(self, name: str) -> Iterator[str]:
        """What it does, in words. The first line follows the label and the name."""

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Keys that contradict each other: the key ("" for the whole table), and what is wrong."""
        return iter(())

    def inputs(self) -> dict[str, str]:
        """The inputs that carry it: the keys of INPUTS that it has, and their values."""
        names = {key: getattr(self, key, None) for key in INPUTS}
        return {key: name for key, name in names.items() if name is not None}


def split_signal(signal: str) -> tuple[str, str]:
    """MESSAGE.SIGNAL as its message and its own name."""
    message, _, name = signal.partition(".")
    return message, name


def messages_of(signals: Iterable[str]) -> dict[str, float]:
    """The messages of a bus that carry these signals, with the rate to request: none."""
    return {split_signal(signal)[0]: 0.0 for signal in signals}


def signal_contradictions(section: Sensor, needed: tuple[str, ...], others: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """What is wrong with a sensor that comes by link, or by bus with the keys `needed` and perhaps `others`."""
    inputs = section.inputs()
    if len(inputs) != 1:
        yield "", "one of 'link' (MAVLink) and 'bus' (CAN) is needed, and not both"
        return
    for key in needed:
        if "bus" in inputs and getattr(section, key) is None:
            yield "", f"the key '{key}' is missing: it comes by bus"
    for key in needed + others:
        if "link" in inputs and getattr(section, key):
            yield key, "has no meaning for a sensor that comes by link"


def vector_in_words(vector: Vector3) -> str:
    return " ".join(f"{value:g}" for value in vector)


def point_in_words(point_m: Vector3) -> str:
    return f"{vector_in_words(point_m)} m (forward, right, down)"


def delay_in_words(delay_ms: float) -> str:
    return f"delay {delay_ms:g} ms" if delay_ms else "no delay"
