"""CAN frames that look like speeds: by the presets, and by how they follow the speed of GNSS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from msgspec.structs import replace

from fusiond.app.inspection.facts import WheelFacts
from fusiond.app.presets import names, preset
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.events import WheelSpeed
from fusiond.maths.typed import Array
from fusiond.units import SECOND
from fusiond_adapters.can.decoder import CanDecoder, frame_key, parameter_group
from fusiond_adapters.logs.survey import Stream, Survey

FASTEST = 80.0  # m/s
LEAST_FRAMES = 20
LIKE = 0.98  # correlation with the GNSS speed from which a field looks like a speed
LEAST_VALID = 0.9  # share of a preset's readings
AGREE = 0.1  # of the speed, by which the wheels of one car may differ in the median
LEAST_MOVED = 1.0  # m/s, standard deviation of the speed from which a correlation says something
LEAST_VALUES = 8  # different values of a field that is no flag
MOST_LISTED = 12


def speeds(survey: Survey, gnss: Array, described: Iterable[tuple[int, bool]]) -> list[WheelFacts]:
    """What looks like speeds in a CAN log, presets first. `gnss`: (n, 2) Unix time [s], speed [m/s]; it may be empty.
    `described`: the ids that DBC files have, which are not searched."""
    fitting = by_presets(survey, gnss)
    told = {name for fit in fitting for name in fit.name.split(", ")}
    known = {name for name, number in survey.ids.items() if number in set(described) or name.partition(" ")[0] in told}
    return [*fitting, *by_correlation(survey, gnss, known)]


def by_presets(survey: Survey, gnss: Array) -> list[WheelFacts]:
    """The presets that a CAN log fits, the best first."""
    found = []
    for name in names():
        settings = _only_wheels(config.load(preset(name)))
        ((bus, _),) = settings.can.items()
        decoder = CanDecoder(settings, bus)
        for channel in sorted({stream.sender for stream in survey.streams.values()}):
            streams = [
                stream
                for stream in survey.streams.values()
                if stream.sender == channel and _is_wanted(decoder, *survey.ids[stream.name])
            ]
            fit = _fit(decoder, survey, streams, gnss, len(settings.wheel))
            if fit is not None:
                ids = ", ".join(sorted({stream.name.partition(" ")[0] for stream in streams}))
                what, (correlation, factor) = ", ".join(settings.wheel), fit
                found.append(
                    WheelFacts(channel=channel, name=ids, what=what, preset=name, correlation=correlation, factor=factor)
                )
    return sorted(found, key=lambda one: (-one.what.count(","), -(one.correlation or 0.0)))


def _only_wheels(settings: Config) -> Config:
    """A configuration without what else comes by its bus."""
    ((bus, _),) = settings.can.items()
    others = {one.table for one in settings.sensors(bus=bus)} - {"wheel"}
    return replace(settings, **{table: {} for table in others})


def _is_wanted(decoder: CanDecoder, number: int, is_extended: bool) -> bool:
    return frame_key(number, is_extended) in decoder.keys or (is_extended and parameter_group(number) in decoder.groups)


def _fit(
    decoder: CanDecoder, survey: Survey, streams: Sequence[Stream], gnss: Array, wheels: int
) -> tuple[float | None, float | None] | None:
    """Correlation with the GNSS speed, and their ratio, of what a preset reads; None where it does not fit."""
    speeds: dict[str, list[tuple[float, float]]] = {}
    events = 0
    for stream in streams:
        number, is_extended = survey.ids[stream.name]
        for t_ns, data in stream.kept:
            for event in decoder.decode(number, is_extended, data, t_ns):
                events += 1
                if isinstance(event.payload, WheelSpeed):
                    speeds.setdefault(event.source, []).append((t_ns / SECOND, event.payload.speed))
    if len(speeds) < wheels or sum(map(len, speeds.values())) < max(LEAST_FRAMES, LEAST_VALID * events):
        return None
    rows = [np.array(one) for one in speeds.values()]
    count = min(map(len, rows))
    columns = np.stack([one[:count, 1] for one in rows])
    mean = columns.mean(0)
    if columns.min() < -FASTEST or columns.max() > FASTEST or mean.std() == 0:
        return None
    if np.median(columns.max(0) - columns.min(0)) > AGREE * max(1.0, float(np.median(np.abs(mean)))):
        return None
    follows = follow(np.stack([rows[0][:count, 0], mean], 1), gnss)
    if follows is None:
        return None, None
    return follows if follows[0] > LIKE - AGREE else None


def follow(readings: Array, gnss: Array) -> tuple[float, float] | None:
    """Correlation of readings with the GNSS speed, and that speed over them; None where there is too little. Both (n, 2)."""
    if len(gnss) < LEAST_FRAMES or len(readings) < LEAST_FRAMES:
        return None
    inside = (readings[:, 0] > gnss[0, 0]) & (readings[:, 0] < gnss[-1, 0])
    values = readings[inside, 1]
    speed = np.interp(readings[inside, 0], gnss[:, 0], gnss[:, 1])
    if len(values) < LEAST_FRAMES or speed.std() < LEAST_MOVED or values.std() == 0:
        return None
    correlation = float(np.corrcoef(values, speed)[0, 1])
    return correlation, float(values @ speed / (values @ values))


def by_correlation(survey: Survey, gnss: Array, known: Iterable[str]) -> list[WheelFacts]:
    """Fields of frames that follow the GNSS speed: unsigned, of 8 or 16 bits, at whole bytes. `known`: ids left out."""
    left_out, found = set(known), []
    for stream in survey.streams.values():
        if stream.name in left_out or len(stream.kept) < LEAST_FRAMES:
            continue
        best: WheelFacts | None = None
        for what, values in _fields(stream):
            offset = values[:, 1] - values[:, 1].min()  # a field may have an offset: its least value stands for 0
            follows = follow(np.stack([values[:, 0], offset], 1), gnss)
            if follows is not None and follows[0] > max(LIKE, (best.correlation or 0.0) if best else 0.0):
                best = WheelFacts(
                    channel=stream.sender, name=stream.name, what=what, preset="", correlation=follows[0], factor=follows[1]
                )
        if best is not None:
            found.append(best)
    return sorted(found, key=lambda one: -(one.correlation or 0.0))[:MOST_LISTED]


def _fields(stream: Stream) -> Iterator[tuple[str, Array]]:
    """The bytes of a stream's frames, and their pairs, as numbers: a description, and (n, 2) time [s] and value."""
    size = min(len(data) for _, data in stream.kept)
    t_s = np.array([t_ns / SECOND for t_ns, _ in stream.kept])
    raw = np.array([list(data[:size]) for _, data in stream.kept], float).reshape(len(t_s), size)
    for at in range(size):
        fields = [(f"byte {at}", raw[:, at])]
        if at + 1 < size:
            fields.append((f"bytes {at}-{at + 1} big-endian", raw[:, at] * 256 + raw[:, at + 1]))
            fields.append((f"bytes {at}-{at + 1} little-endian", raw[:, at] + raw[:, at + 1] * 256))
        for what, values in fields:
            if len(np.unique(values)) >= LEAST_VALUES:
                yield what, np.stack([t_s, values], 1)
