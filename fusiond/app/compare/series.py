"""A track as arrays: of a CSV file, of a replay with a configuration, or the autopilot's own in a log."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusiond.app.replay.replay import Replay, ReplayTask
from fusiond.config.schema import Config
from fusiond.errors import UnusableError
from fusiond.maths.typed import Array, Stamps
from fusiond.messages.csv import CSV_COLUMNS
from fusiond.messages.types import StateMessage
from fusiond.units import MICROSECOND
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.own_estimate import own_estimate

NUMBERS = CSV_COLUMNS[1:-1]
COUNT = len(NUMBERS)
SIGMAS = 5  # columns of sigmas, at the end


class SeriesError(UnusableError):
    """A track that cannot be compared; the message names it."""


@dataclass(frozen=True)
class Series:
    """A track: N states with rising stamps."""

    name: str
    t_ns: Stamps  # (N,)
    numbers: Array  # (N, COUNT), by CSV_COLUMNS without stamp and mode; NaN where there is none
    mode: NDArray[np.str_]  # (N,), empty where there is none

    def column(self, name: str) -> Array:
        """One column, by its name in a CSV file."""
        return self.numbers[:, NUMBERS.index(name)]

    @classmethod
    def of(cls, name: str, t_ns: Sequence[int], numbers: Sequence[Sequence[float]], mode: Sequence[str]) -> Series:
        """A series of rows; those that do not come after all before them are left out. Raises SeriesError without rows."""
        stamps = np.array(t_ns, dtype=np.int64)
        if not len(stamps):
            raise SeriesError(f"{name}: no states to compare")
        rising = np.concatenate([[True], stamps[1:] > np.maximum.accumulate(stamps)[:-1]])
        table = np.array(numbers, dtype=np.float64).reshape(len(stamps), COUNT)
        return cls(name, stamps[rising], table[rising], np.array(mode, dtype=np.str_)[rising])


def of_csv(path: Path) -> Series:
    """The states of a file as `replay --csv` writes it. Raises SeriesError."""
    t_ns, numbers, modes = list[int](), list[list[float]](), list[str]()
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            missing = [column for column in CSV_COLUMNS if column not in (reader.fieldnames or ())]
            if missing:
                raise SeriesError(f"{path}:1: no column {', '.join(missing)}; a track of `fusiond replay --csv` is needed")
            for row in reader:
                if row["lat_deg"]:
                    t_ns.append(int(row["unix_us"]) * MICROSECOND)
                    numbers.append([float(row[column]) for column in NUMBERS])
                    modes.append(row["mode"])
    except (ValueError, TypeError, csv.Error) as error:
        raise SeriesError(f"{path}: line {len(t_ns) + 2} or so: {error}") from error
    except OSError as error:
        raise SeriesError(f"{path}: cannot be read: {error.strerror}") from error
    return Series.of(str(path), t_ns, numbers, modes)


def of_replay(name: str, config: Config, logs: Sequence[str], rate_hz: float | None = None) -> Series:
    """The states of a replay. Raises ConfigError, LogError, SeriesError."""
    t_ns, numbers, modes = list[int](), list[tuple[float, ...]](), list[str]()

    def add(message: StateMessage, _: object) -> None:
        state = message.state
        if state is None:
            return
        t_ns.append(message.t_ns)
        modes.append(message.mode.value)
        attitude = (state.roll_deg, state.pitch_deg, state.yaw_deg)
        sigmas = (*state.sigma_position_ned_m, state.sigma_velocity_mps, state.sigma_yaw_deg)
        numbers.append((state.lat_deg, state.lon_deg, state.height_m, *state.velocity_ned_mps, *attitude, *sigmas))

    Replay(config, ReplayTask(rate_hz or config.publish.rate_hz, on_tick=[add])).run(open_logs(logs, config))
    return Series.of(name, t_ns, numbers, modes)


def of_autopilot(path: str) -> Series:
    """What the autopilot held for true, in its log. It has no sigmas. Raises LogError, SeriesError."""
    t_ns, numbers = list[int](), list[tuple[float, ...]]()
    for state in own_estimate(path):
        t_ns.append(state.t_ns)
        place = math.degrees(state.latitude), math.degrees(state.longitude), state.height
        unknown = (math.nan,) * SIGMAS
        numbers.append((*place, *state.velocity_n, math.nan, math.nan, math.degrees(state.yaw), *unknown))
    return Series.of(f"the autopilot's own in {path}", t_ns, numbers, [""] * len(t_ns))
