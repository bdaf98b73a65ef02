"""A configuration to start from, out of what is in logs."""

from __future__ import annotations

import os
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fusiond.app.inspection import by_dbc
from fusiond.app.presets import preset
from fusiond_adapters.logs.survey import Survey

IMU_MESSAGES = ("HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU")
NO_WHEELS = re.compile("COPTER|ROTOR|PLANE|WING|VTOL|HELI|SUBMARINE|BOAT|BALLOON", re.I)  # in a sender's description
RECEIVERS = {  # message: the same in an autopilot's own log
    "GPS_RAW_INT": r"GPS(\[0\])?$|(sensor_gps|vehicle_gps_position)\[0\]",
    "GPS2_RAW": r"GPS2|GPS\[1\]|sensor_gps\[1\]",
}
CORNERS = {  # of a car whose IMU is near its middle, until it is measured
    "front_left": (1.8, -0.78, 0.6), "front_right": (1.8, 0.78, 0.6), "rear_left": (-0.9, -0.78, 0.6),
    "rear_right": (-0.9, 0.78, 0.6),
}  # fmt: skip
AXLE = (-0.9, 0.0, 0.6)
LEARNT_DELAY_MS = 200.0  # where nothing tells it: the filter learns it
MEASURE = "measure it on the vehicle: forward, right, down from the IMU [m]"


class Table(NamedTuple):
    """A table of the configuration: its keys with their values, and why they are so."""

    name: str
    keys: dict[str, Any]
    why: dict[str, str]


class Draft:
    """A configuration in the making."""

    def __init__(self) -> None:
        self.tables: list[Table] = []
        self.copied: list[Path] = []  # DBC files of fusiond
        self.notes: list[str] = []
        self.described: set[tuple[int, bool]] = set()  # ids that the DBC files have

    def add(self, name: str, keys: Mapping[str, Any], why: Mapping[str, str] | None = None) -> None:
        """Add a table."""
        self.tables.append(Table(name, dict(keys), dict(why or {})))

    def has(self, kind: str) -> bool:
        """Whether there is a table of a kind, such as imu."""
        return any(table.name.startswith(f"{kind}.") for table in self.tables)

    def table(self, kind: str) -> Table:
        """The first table of a kind."""
        return next(table for table in self.tables if table.name.startswith(f"{kind}."))

    def drop_empty_buses(self) -> None:
        """Leave out the buses that no sensor comes by."""
        used = {table.keys.get("bus") for table in self.tables}
        self.tables = [table for table in self.tables if not table.name.startswith("can.") or table.name[4:] in used]

    def text(self, heading: Iterable[str] = ()) -> str:
        """The configuration as TOML."""
        lines = [f"# {line}" for line in heading]
        for name, keys, why in self.tables:
            lines += ["", f"[{name}]"]
            for key, value in keys.items():
                line = f"{key} = {_toml(value)}"
                lines.append(f"{line:<35} # {why[key]}" if key in why else line)
        return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return str(value)


def draft(surveys: Sequence[Survey], dbcs: Sequence[Path], folder: Path) -> Draft:
    """The sensors that logs have, without wheels of presets. `folder`: of the configuration. Raises ConfigError."""
    made = Draft()
    made.add("vehicle", {"name": "vehicle"}, {"name": "names it in everything that is published"})
    links = [survey for survey in surveys if survey.protocol == "mavlink"]
    if any(NO_WHEELS.search(words) for survey in links for words in survey.senders.values()):
        why = "it is no vehicle on wheels"
        made.add("motion", {"non_holonomic": False, "standstill": False}, {"non_holonomic": why, "standstill": why})
    else:
        made.add("motion", {"point_m": AXLE}, {"point_m": f"the middle of the unsteered axle; {MEASURE}"})
    if links:
        _link(made, links)
    buses = [survey for survey in surveys if survey.protocol == "can"]
    if buses:
        _buses(made, buses, dbcs, folder)
    return made


def _link(made: Draft, links: Sequence[Survey]) -> None:
    """The link of autopilots' logs and its sensors."""
    streams = [stream for survey in links for stream in survey.streams.values()]
    senders = {sender: words for survey in links for sender, words in survey.senders.items()}
    autopilots = [name for name, words in senders.items() if not re.search("INVALID|GCS", words)]
    counts: Counter[str] = Counter()
    for one in streams:
        counts[one.sender] += one.count
    chosen = max(autopilots or senders or counts, key=lambda sender: counts[sender])
    own = {one.name: one for one in streams if one.sender == chosen}
    keys: dict[str, Any] = {}
    if "ARDUPILOT" in senders.get(chosen, ""):
        keys["dialect"] = "ardupilotmega"
    system = re.match(r"system (\d+)", chosen)
    if system and len({one.sender.partition(",")[0] for one in streams}) > 1:
        keys["system"] = int(system[1])
    made.add("mavlink.autopilot", keys, {"system": "others are in the log as well"})
    inertial = [own[name] for name in IMU_MESSAGES if name in own]
    if inertial:
        best = max(inertial, key=lambda one: one.rate_hz)
        made.add("imu.imu0", {"link": "autopilot", "message": best.name})
    elif any(re.match(r"IMU(\[0\])?$|sensor_combined", name) for name in own):
        made.add("imu.imu0", {"link": "autopilot"})
    for number, (message, others) in enumerate(RECEIVERS.items()):
        if message in own or any(re.match(others, name) for name in own):
            keys = {"link": "autopilot", "message": message, "lever_arm_m": (0.2, 0.0, -0.9)}
            _add_gnss(made, f"gps{number}", keys)
    if "WHEEL_DISTANCE" in own or "WENC" in own or "RWOH" in own or "wheel_encoders[0]" in own:
        sides = ("right", "left") if "wheel_encoders[0]" in own else ("left", "right")
        for index, side in enumerate(sides):
            place = (0.0, -0.25 if side == "left" else 0.25, 0.2)
            keys = {"link": "autopilot", "index": index, "unsigned": False, "position_m": place}
            made.add(f"wheel.{side}", keys, {"position_m": MEASURE})


def _add_gnss(made: Draft, name: str, keys: Mapping[str, Any]) -> None:
    learnt: dict[str, Any] = {}
    if not made.has("gnss"):
        learnt = {"delay_sigma_ms": LEARNT_DELAY_MS, "velocity_delay_sigma_ms": LEARNT_DELAY_MS}
    why = "a log does not tell how late fixes come: it is learnt; give delay_ms where you know it"
    made.add(f"gnss.{name}", {**keys, **learnt}, {"lever_arm_m": f"the antenna; {MEASURE}", "delay_sigma_ms": why})


def bus_name(channel: str) -> str:
    """The name of the bus of a log's channel."""
    name = re.sub(r"\W", "_", channel)
    return name if re.match("[A-Za-z]", name) else f"can{name}"


def _buses(made: Draft, buses: Sequence[Survey], dbcs: Sequence[Path], folder: Path) -> None:
    """The buses of CAN logs, and the sensors that the DBC files describe."""
    described = by_dbc.messages_of(dbcs)
    made.described = {(one.frame_id, one.is_extended_frame) for messages in described.values() for one in messages}
    ids: dict[str, set[tuple[int, bool]]] = {}  # by channel
    for survey in buses:
        for channel, name in survey.streams:
            ids.setdefault(channel, set()).add(survey.ids[name])
    for channel, present in sorted(ids.items()):
        here = {
            path: [one for one in messages if (one.frame_id, one.is_extended_frame) in present]
            for path, messages in described.items()
        }
        used = [path for path, messages in here.items() if messages]
        bus = bus_name(channel)
        keys: dict[str, Any] = {"dbc": [_relative(path, folder) for path in used]}
        if channel != bus and channel:
            keys["log_channel"] = channel
        made.add(f"can.{bus}", keys, {"log_channel": "the channel of this bus in the log"})
        messages = [message for path in used for message in here[path]]
        _bus_sensors(made, bus, messages, buses, channel)


def _bus_sensors(made: Draft, bus: str, messages: Sequence[Any], buses: Sequence[Survey], channel: str) -> None:
    inertial, receiver = by_dbc.imu(messages), by_dbc.gnss(messages)
    if inertial is not None and not made.has("imu"):
        keys = {"bus": bus, **inertial}
        rate = _rate(buses, channel, messages, inertial["accel_signals"][0])
        made.add("imu.imu0", {**keys, "rate_hz": rate}, {"rate_hz": "as found in the log"})
    if receiver is not None:
        rate = _rate(buses, channel, messages, receiver["latitude_signal"])
        keys = {"bus": bus, **receiver, "lever_arm_m": (0.2, 0.0, -0.9), "interval_s": round(1 / rate, 3)}
        count = sum(table.name.startswith("gnss.") for table in made.tables)
        _add_gnss(made, f"gps{count}", {**keys, "stamp_sigma_ms": 20.0})
    for name, wheel in by_dbc.wheels(messages):
        if not any(table.name == f"wheel.{name}" for table in made.tables):
            add_wheel(made, name, {"bus": bus, **wheel})


def _rate(buses: Sequence[Survey], channel: str, messages: Sequence[Any], signal: str) -> float:
    """The rate [Hz] of the message of a signal in the logs."""
    message = next(one for one in messages if one.name == signal.partition(".")[0])
    for survey in buses:
        for (sender, name), stream in survey.streams.items():
            if sender == channel and survey.ids[name] == (message.frame_id, message.is_extended_frame) and stream.rate_hz:
                return round(stream.rate_hz, 1)
    return 1.0


def add_wheel(made: Draft, name: str, keys: Mapping[str, Any]) -> None:
    """Add a wheel, where it stands on a car."""
    steered = {"steered": True} if name.startswith("front") else {}
    made.add(f"wheel.{name}", {**keys, "position_m": CORNERS.get(name, AXLE), **steered}, {"position_m": MEASURE})


def add_preset(made: Draft, name: str, channel: str) -> None:
    """Add the wheels of a preset to the bus of a channel; its DBC file is to be copied beside the configuration."""
    settings = tomllib.loads(preset(name).read_text(encoding="utf-8"))
    bus = bus_name(channel)
    table = next(table for table in made.tables if table.name == f"can.{bus}")
    ((_, can),) = settings["can"].items()
    for dbc in can["dbc"]:
        table.keys["dbc"] = [*table.keys["dbc"], dbc]
        made.copied.append(preset(name).parent / dbc)
    if "j1939" in can:
        table.keys["j1939"] = can["j1939"]
    for wheel, keys in settings["wheel"].items():
        made.add(f"wheel.{wheel}", {**keys, "bus": bus}, {"position_m": MEASURE})


def _relative(path: Path, folder: Path) -> str:
    """A path as the configuration in a folder names it."""
    return os.path.relpath(path.resolve(), folder.resolve())
