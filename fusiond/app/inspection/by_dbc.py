"""The sensors that DBC files describe, by the names and units of their signals, among the messages that a log has."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cantools
from cantools.database.can import Database, Message, Signal

from fusiond.config.toml import ConfigError
from fusiond_adapters.can.sensors import DBC_UNITS

Keys = dict[str, Any]  # of a table of the configuration

ACCEL_UNITS = {"m/s^2": "m/s^2", "m/s2": "m/s^2", "m/s²": "m/s^2", "g": "g", "mg": "mg"}
GYRO_UNITS = {"deg/s": "deg/s", "°/s": "deg/s", "dps": "deg/s", "rad/s": "rad/s"}
AXIS = re.compile(r"(?:^|[_ ]|(?<=[a-z]))([XYZxyz])(?:$|[_ ]|(?=[A-Z]))")
CORNER = re.compile(
    r"(?:^|_|[a-z])(FL|FR|RL|RR|LF|RF|LR)(?:$|_)|(front|rear|back).?(left|right)|(left|right).?(front|rear|back)"
)
CORNERS = {"FL": "front_left", "LF": "front_left", "FR": "front_right", "RF": "front_right", "RL": "rear_left",
           "LR": "rear_left", "RR": "rear_right"}  # fmt: skip
METRIC = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}  # m/s, of the units of wheels
SPEED_UNITS = {"m/s": "m/s", "km/h": "km/h", "mph": "mph", "knots": "kn", "kn": "kn", "kt": "kn"}
FIXES = (  # words of a named value: GPS_FIX_TYPE
    (r"no.?fix|invalid|none|time only|dead reckoning only", 0), (r"rtk.?fix|fixed", 6), (r"float", 5),
    (r"dgps|diff|sbas", 4), (r"3.?d|combined", 3), (r"2.?d", 2),
)  # fmt: skip


def messages_of(paths: Iterable[Path]) -> dict[Path, list[Message]]:
    """The messages of DBC files. Raises ConfigError."""
    found = {}
    for path in paths:
        try:
            database = cantools.database.load_file(path, database_format="dbc", strict=False)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
        except (cantools.Error, ValueError, LookupError) as error:
            raise ConfigError(f"{path}: not a valid DBC file: {error}") from error
        found[path] = list(database.messages) if isinstance(database, Database) else []
    return found


def imu(messages: Iterable[Message]) -> Keys | None:
    """The keys of an [imu.NAME]; None where three accelerations and three rates are not found."""
    signals = [(message, signal) for message in messages for signal in message.signals]
    force, rate = _axes(signals, ACCEL_UNITS), _axes(signals, GYRO_UNITS)
    if force is None or rate is None:
        return None
    keys: Keys = {"accel_signals": force[0], "gyro_signals": rate[0], "accel_unit": force[1], "gyro_unit": rate[1]}
    used = {name.partition(".")[0] for name in (*force[0], *rate[0])}
    return keys | _valid(used, signals)


def _axes(signals: Iterable[tuple[Message, Signal]], units: Mapping[str, str]) -> tuple[list[str], str] | None:
    """The signals along x, y and z with a unit of these, of one message or several, and the unit."""
    axes: dict[str, str] = {}
    unit = ""
    for message, signal in signals:
        known = units.get((signal.unit or "").strip().lower())
        axis = AXIS.search(signal.name)
        if known and axis and axis[1].lower() not in axes and unit in ("", known):
            axes[axis[1].lower()] = f"{message.name}.{signal.name}"
            unit = known
    return ([axes[axis] for axis in "xyz"], unit) if len(axes) == 3 else None


def gnss(messages: Iterable[Message]) -> Keys | None:
    """The keys of a [gnss.NAME]; None where latitude, longitude and height are not found."""
    signals = [(message, signal) for message in messages for signal in message.signals]

    def first(pattern: str, units: Iterable[str] | None = None, inside: str = "") -> tuple[str, str] | None:
        for message, signal in signals:
            unit = (signal.unit or "").strip().lower()
            named = re.search(pattern, signal.name, re.I) and re.search(inside, message.name, re.I)
            if named and (units is None or unit in units):
                return f"{message.name}.{signal.name}", unit
        return None

    degrees = ("deg", "°", "degree", "degrees")
    accuracy = r"(acc(uracy)?$|sigma|std|_acc)"
    latitude, longitude = first(r"^lat", degrees), first(r"^lon", degrees)
    height = first(r"^(alt|height)(?!.*acc)", ("m", "meter", "metre"))
    if latitude is None or longitude is None or height is None:
        return None
    keys: Keys = {"latitude_signal": latitude[0], "longitude_signal": longitude[0], "height_signal": height[0]}
    family = "gnss|gps|" + re.escape(latitude[0].partition(".")[0])
    speed = first(r"speed(?!.*acc)", SPEED_UNITS, family)
    course = first(r"^(course|cog|track|heading)(?!.*acc)", degrees, family)
    if speed and course:
        keys |= {"speed_signal": speed[0], "course_signal": course[0]}
        if SPEED_UNITS[speed[1]] != "m/s":
            keys["speed_unit"] = SPEED_UNITS[speed[1]]
    sigmas = {
        "position_sigma_signal": first(rf"pos\w*{accuracy}", ("m",), family),
        "height_sigma_signal": first(rf"(alt|height)\w*{accuracy}", ("m",), family),
        "velocity_sigma_signal": first(rf"speed\w*{accuracy}", SPEED_UNITS, family) if speed else None,
        "course_sigma_signal": first(rf"(course|heading|track)\w*{accuracy}", degrees, family) if course else None,
        "time_signal": first(r"epoch|unix|utc", ("s", "sec"), family + "|time"),
        "fix_type_signal": first(r"^fix", None, family),
    }
    keys |= {key: found[0] for key, found in sigmas.items() if found}
    if "fix_type_signal" in keys:
        keys["fix_types"] = _fix_types(next(s for m, s in signals if f"{m.name}.{s.name}" == keys["fix_type_signal"]))
    used = {name.partition(".")[0] for key, name in keys.items() if key.endswith("_signal")}
    return keys | _valid(used, signals)


def _fix_types(signal: Signal) -> list[int]:
    """GPS_FIX_TYPE by the value of a signal, by the names of its values; none where it has no names."""
    choices = {int(value): str(name) for value, name in (signal.choices or {}).items()}
    kinds = {v: next((kind for words, kind in FIXES if re.search(words, name, re.I)), 0) for v, name in choices.items()}
    return [kinds.get(value, 0) for value in range(max(kinds, default=-1) + 1)]


def _valid(used: Iterable[str], signals: Iterable[tuple[Message, Signal]]) -> Keys:
    """The flags of these messages that say that they are valid."""
    names = [
        f"{message.name}.{signal.name}"
        for message, signal in signals
        if message.name in used and signal.length == 1 and re.search("valid", signal.name, re.I)
    ]
    return {"valid_signals": names} if names else {}


def wheels(messages: Iterable[Message]) -> Iterator[tuple[str, Keys]]:
    """The wheels: name, and the keys of its [wheel.NAME], by corner."""
    for message in messages:
        for signal in message.signals:
            unit = DBC_UNITS.get((signal.unit or "").strip().lower())
            corner = _corner(signal.name)
            if unit in METRIC and corner:
                keys: Keys = {"message": message.name, "signal": signal.name, "unit": unit, "unsigned": not signal.is_signed}
                if signal.scale:
                    keys["quantum_mps"] = round(abs(signal.scale) * METRIC[unit], 6)
                yield corner, keys


def _corner(name: str) -> str:
    """The corner of a car that the name of a signal has, such as rear_left; empty without one."""
    found = CORNER.search(name) or CORNER.search(name.lower())
    if found is None:
        return ""
    if found[1]:
        return CORNERS[found[1]]
    words = {word.replace("back", "rear") for word in found.groups()[1:] if word}
    return "_".join(word for word in ("front", "rear", "left", "right") if word in words)
