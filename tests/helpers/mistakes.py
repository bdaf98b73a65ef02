"""Deliberate mistakes for the doctor: configurations and logs with one thing wrong, and what it should name."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common

from fusiond.simulation.scenario import parse
from fusiond_adapters.logs.write import write_drive
from tests.helpers.paths import CAPTURED, ROOT

RAV4 = CAPTURED / "comma2k19-rav4"
DRIVE = """
seed = {seed}
[[segment]]
duration_s = 4
[[segment]]
duration_s = 7
speed_mps = 12.0
[[segment]]
duration_s = 6
turn_deg = 80.0
[[segment]]
duration_s = 6
speed_mps = 17.0
turn_deg = -30.0
[[segment]]
duration_s = 6
speed_mps = 7.0
[[segment]]
duration_s = 6
turn_deg = -95.0
[[segment]]
duration_s = 7
speed_mps = 14.0
[[segment]]
duration_s = 6
turn_deg = 70.0
[[segment]]
duration_s = 6
speed_mps = 9.0
[[segment]]
duration_s = 5
turn_deg = -75.0
[[segment]]
duration_s = 6
speed_mps = 15.0
[[segment]]
duration_s = 6
turn_deg = 85.0
speed_mps = 10.0
[[segment]]
duration_s = 5
speed_mps = 0.0
{more}
"""
LOGS = ("drive.tlog", "drive.log")
Change = Callable[[Any], Any]  # a MAVLink message to the one that takes its place; None: none does


class Case(NamedTuple):
    """Files of a drive: configuration, then logs."""

    config: Path
    logs: list[str]


class Mistake(NamedTuple):
    """One thing wrong, and what should be said of it: the kind of the finding, and part of the key."""

    name: str
    make: Callable[[Path], Case]
    kinds: frozenset[str]
    key: str


# --- Drives


def simulated(folder: Path, seed: int = 1, more: str = "") -> Case:
    """A simulated drive of a minute and a quarter, and the configuration that fits it."""
    folder.mkdir(parents=True, exist_ok=True)
    write_drive(parse(DRIVE.format(seed=seed, more=more)), folder)
    return Case(folder / "fusiond.toml", [str(folder / log) for log in LOGS])


def captured(folder: Path, tlog: str = "drive.tlog") -> Case:
    """The RAV4's 30 s, with its configuration."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("rav4.toml", "rav4.dbc"):
        (folder / name).write_bytes((ROOT / "configs" / name).read_bytes())
    return Case(folder / "rav4.toml", [str(RAV4 / tlog), str(RAV4 / "drive.candump.log")])


# --- Changes


def edited(case: Case, *changes: tuple[str, str]) -> Case:
    """The case with its configuration changed, by regular expressions of whole lines' beginnings."""
    text = case.config.read_text()
    for pattern, new in changes:
        text, count = re.subn(pattern, new, text, flags=re.MULTILINE)
        assert count, pattern
    case.config.write_text(text)
    return case


def rewritten(case: Case, change: Change) -> Case:
    """The case with the messages of its .tlog changed."""
    source = Path(case.logs[0]).read_bytes()
    target = case.config.parent / "changed.tlog"
    parser, sender, at = common.MAVLink(None), common.MAVLink(None, 1, 1), 0
    with target.open("wb") as file:
        while at + 8 < len(source):
            length = 8 + (12 if source[at + 8] == 0xFD else 8) + source[at + 9]
            message = parser.decode(bytearray(source[at + 8 : at + length]))
            found = change(message)
            if found is not None:
                sender.seq = message.get_seq()
                sender.srcSystem, sender.srcComponent = message.get_srcSystem(), message.get_srcComponent()
                file.write(source[at : at + 8] + found.pack(sender))
            at += length
    return Case(case.config, [str(target), *case.logs[1:]])


def shifted(case: Case, seconds: int) -> Case:
    """The case with the stamps of its CAN log shifted."""
    target = case.config.parent / "shifted.log"
    lines = Path(case.logs[1]).read_text().splitlines()
    moved = (re.sub(r"^\((\d+)", lambda found: f"({int(found[1]) + seconds}", line) for line in lines)
    target.write_text("\n".join(moved) + "\n")
    return Case(case.config, [case.logs[0], str(target)])


def inertial(factor: Callable[[str], float]) -> Change:
    """The inertial samples with each field multiplied."""

    def change(message: Any) -> Any:
        if message.get_type() == "HIGHRES_IMU":
            for field in ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro"):
                setattr(message, field, getattr(message, field) * factor(field))
        return message

    return change


def fixes(**fields: Callable[[int], int]) -> Change:
    """The fixes with some fields changed."""

    def change(message: Any) -> Any:
        if message.get_type() == "GPS_RAW_INT":
            for field, new in fields.items():
                setattr(message, field, new(getattr(message, field)))
        return message

    return change


def thinned(message: str, every: int) -> Change:
    """Every so manieth message of a kind."""
    seen = 0

    def change(one: Any) -> Any:
        nonlocal seen
        if one.get_type() != message:
            return one
        seen += 1
        return one if seen % every == 1 else None

    return change


def _standing(folder: Path) -> Case:
    folder.mkdir(parents=True, exist_ok=True)
    write_drive(parse("[[segment]]\nduration_s = 40\n"), folder)
    return Case(folder / "fusiond.toml", [str(folder / log) for log in LOGS])


def swapped(folder: Path) -> Case:
    """Left and right wheels taken for each other."""
    case = simulated(folder)
    text = case.config.read_text()
    for a, b in (("FL", "FR"), ("RL", "RR")):
        text = text.replace(f"SPEED_{a}", "SPEED_?").replace(f"SPEED_{b}", f"SPEED_{a}").replace("SPEED_?", f"SPEED_{b}")
    case.config.write_text(text)
    return case


def other_dbc(folder: Path, old: str, new: str) -> Case:
    case = captured(folder)
    dbc = folder / "rav4.dbc"
    text = dbc.read_text()
    assert old in text
    dbc.write_text(text.replace(old, new))
    return case


def of(name: str, kinds: str, key: str, make: Callable[[Path], Case]) -> Mistake:
    return Mistake(name, make, frozenset(kinds.split()), key)


CAR = (  # on the captured drive
    of(
        "wheels in km/h taken for m/s",
        "wheel_unit",
        ".unit",
        lambda f: edited(captured(f), ('^unit = "km/h"', 'unit = "m/s"')),
    ),
    of(
        "wheels in km/h taken for mph",
        "wheel_unit",
        ".unit",
        lambda f: edited(captured(f), ('^unit = "km/h"', 'unit = "mph"')),
    ),
    of(
        "a wheel's scale with a wrong sign",
        "wheel_sign",
        "front_left.scale",
        lambda f: edited(captured(f), (r"^unsigned = true.*", "unsigned = false\nscale = -1.0")),
    ),
    of("a DBC without the offset", "wheel_offset", ".dbc", lambda f: other_dbc(f, "(0.01,-67.67)", "(0.01,0)")),
    of("a DBC with the wrong byte order", "wheel_unrelated", ".signal", lambda f: other_dbc(f, "15@0+", "8@1+")),
    of(
        "the sensor upside down",
        "imu_mount",
        "rotation_deg",
        lambda f: edited(
            captured(f), (r"^message = \"HIGHRES_IMU\".*", 'message = "HIGHRES_IMU"\nrotation_deg = [180.0, 0.0, 0.0]')
        ),
    ),
    of(
        "another system", "system", "mavlink.eon.system", lambda f: edited(captured(f), (r"^connection = .*", "system = 42"))
    ),
    of(
        "another inertial message",
        "message",
        "imu0.message",
        lambda f: edited(captured(f), (r"^message = \"HIGHRES_IMU\"", 'message = "RAW_IMU"')),
    ),
    of("logs of two days", "logs_apart", "", lambda f: shifted(captured(f), 86_400)),
    of(
        "only fixed fixes wanted",
        "invalid",
        "minimum_fix_type",
        lambda f: edited(captured(f), (r"^interval_s = 0.1", "minimum_fix_type = 6")),
    ),
    of(
        "a wheel's sigma of 100 m/s",
        "gate",
        ".sigma_mps",
        lambda f: edited(captured(f), (r"^sigma_mps = 0.1 ", "sigma_mps = 100 ")),
    ),
)
SIMULATED = (
    of("left and right swapped", "wheel_side", ".position_m", swapped),
    of(
        "the sensor turned by 90 deg",
        "imu_mount",
        "rotation_deg",
        lambda f: edited(
            simulated(f), (r"^message = \"HIGHRES_IMU\"", 'message = "HIGHRES_IMU"\nrotation_deg = [0, 0, 90]')
        ),
    ),
    of(
        "a mount in radians",
        "imu_mount",
        "rotation_deg",
        lambda f: edited(
            simulated(f, 1, "[imu]\nmount_deg = [0.0, 0.0, 90.0]\n"),
            (r"^message = \"HIGHRES_IMU\"", 'message = "HIGHRES_IMU"\nrotation_deg = [0, 0, 1.5708]'),
            (r"^mount_sigma_deg = .*", "mount_sigma_deg = 1"),
        ),
    ),
    of(
        "a gyro in deg/s",
        "gyro_unit",
        "imu0",
        lambda f: rewritten(simulated(f), inertial(lambda field: math.degrees(1) if "gyro" in field else 1.0)),
    ),
    of(
        "a gyro with a reversed axis",
        "imu_axes",
        "rotation_deg",
        lambda f: rewritten(simulated(f), inertial(lambda field: -1.0 if field == "zgyro" else 1.0)),
    ),
    of(
        "an accelerometer in g",
        "accel_unit",
        "imu0",
        lambda f: rewritten(simulated(f), inertial(lambda field: 1 / 9.81 if "acc" in field else 1.0)),
    ),
    of("an inertial sensor at 1 Hz", "imu_slow", "imu0", lambda f: rewritten(simulated(f), thinned("HIGHRES_IMU", 100))),
    of(
        "a lever arm with a wrong sign",
        "lever_arm",
        "lever_arm_m",
        lambda f: edited(
            simulated(f, 1, "[gnss]\nantenna_m = [2.2, 0.0, -1.6]\n"), (r"^lever_arm_m = \[", "lever_arm_m = [-")
        ),
    ),
    of(
        "a delay of the receiver that is not there",
        "delay",
        "gps0.delay_ms",
        lambda f: edited(simulated(f), (r"^delay_ms = 0 .*", "delay_ms = 500")),
    ),
    of(
        "a delay of the bus that is not there",
        "delay",
        "can.car.delay_ms",
        lambda f: edited(simulated(f), (r"^delay_ms = 0.5 .*", "delay_ms = 500")),
    ),
    of("no velocity", "gnss_no_velocity", "use_velocity", lambda f: rewritten(simulated(f), fixes(vel=lambda _: 65535))),
    of(
        "a velocity backwards",
        "gnss_velocity",
        "gps0",
        lambda f: rewritten(simulated(f), fixes(cog=lambda cog: (cog + 18_000) % 36_000)),
    ),
    of(
        "a velocity in mm/s",
        "gnss_velocity",
        "gps0",
        lambda f: rewritten(simulated(f), fixes(vel=lambda vel: min(vel * 10, 65_534))),
    ),
    of(
        "a heading that is opposite",
        "heading",
        "filter.heading_deg",
        lambda f: edited(simulated(f), (r"^\[filter\]", "[filter]\nheading_deg = 180.0")),
    ),
    of(
        "a gyro limit in rad/s for deg/s",
        "invalid",
        "imu0.gyro_limit",
        lambda f: edited(simulated(f), (r"^message = \"HIGHRES_IMU\"", 'message = "HIGHRES_IMU"\ngyro_limit = 1e-3')),
    ),
    of(
        "a horizon of 20 ms",
        "too_old",
        "filter.horizon_s",
        lambda f: edited(simulated(f), (r"^\[filter\]", "[filter]\nhorizon_s = 0.02\nimu_gap_s = 0.01")),
    ),
    of("wheels of another bus", "missing", "can.car", lambda f: _other_id(simulated(f))),
    of(
        "a sigma of positions of 1 km",
        "gate",
        "gps0.position_sigma_m",
        lambda f: edited(simulated(f), (r"^position_sigma_m = .*", "position_sigma_m = 1000")),
    ),
    of("no rest, no motion", "no_heading", "heading_deg", _standing),
)


def _other_id(case: Case) -> Case:
    dbc = case.config.parent / "wheels.dbc"
    text = dbc.read_text()
    assert "BO_ 464 " in text
    dbc.write_text(text.replace("BO_ 464 ", "BO_ 465 "))
    return case


# --- Right configurations

MORE = (
    "",
    "[imu]\nmount_deg = [0.0, 0.5, -0.7]\n",
    "[imu]\nmount_deg = [1.0, -2.0, 2.0]\n",
    "[wheels]\nscale_error = 0.015\n",
    "[gnss]\nvelocity_lag_ms = 100.0\n",
    "[gnss]\nstamp = \"boot-arrival\"\n",
    "[gnss]\nreport_accuracy = false\n",
    "[vehicle]\nslip_deg_per_mps2 = 0.5\n",
    "[gnss]\nantenna_m = [2.2, 0.4, -1.6]\n",
    "[wheels]\nunsigned = false\n",
    "[barometer]\nrate_hz = 10.0\n",
    "[[wheels.slip]]\nwheel = \"rear_left\"\nstart_s = 30.0\nstop_s = 36.0\nfactor = 1.4\n",
    "[[gnss.jump]]\nstart_s = 40.0\nstop_s = 44.0\noffset_m = [15.0, 5.0, 0.0]\n",
    "[gnss]\nrate_hz = 1.0\n",
    "[imu]\nvibration_hz = [17.0, 31.0]\nvibration_mps2 = 0.3\n",
    "[host]\noffset_s = 3.0\n",
)  # fmt: skip
RIGHT = tuple((f"simulated {number}: {' '.join(more.split()) or 'plain'}", partial(simulated, seed=number, more=more))
              for number, more in enumerate(MORE, 1))  # fmt: skip


def right_husky(folder: Path) -> Case:
    """The slow robot, whose receiver gives no velocity."""
    return _given(
        folder,
        "husky",
        ("drive.tlog", "drive.log"),
        (r"^link = \"fcu\"\nposition", 'link = "fcu"\nuse_velocity = false\nposition'),
    )


def right_everett(folder: Path) -> Case:
    return _given(folder, "everett-rtk", ("drive.tlog",))


def _given(folder: Path, name: str, logs: tuple[str, ...], *changes: tuple[str, str]) -> Case:
    folder.mkdir(parents=True, exist_ok=True)
    for file in (CAPTURED / name).iterdir():
        if file.suffix in (".toml", ".dbc"):
            (folder / file.name).write_bytes(file.read_bytes())
    return edited(Case(folder / "drive.toml", [str(CAPTURED / name / log) for log in logs]), *changes)


def right_late(folder: Path) -> Case:
    """The captured drive with fixes that are stamped at their arrival, and the delay given."""
    return edited(captured(folder, "drive-gps-boot-time.tlog"), (r"^delay_ms = 0.0 .*", "delay_ms = 78.0"))


RIGHT_CAPTURED = (("rav4", captured), ("rav4, late", right_late), ("husky", right_husky), ("everett", right_everett))
