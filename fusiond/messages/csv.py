"""The CSV file of states: its header, and the line of a message. Numbers read back bit for bit."""

from __future__ import annotations

from collections.abc import Iterable

from fusiond.messages.types import State, StateMessage
from fusiond.units import MICROSECOND

CSV_COLUMNS = (
    "unix_us",
    "lat_deg",
    "lon_deg",
    "height_m",
    "vn_mps",
    "ve_mps",
    "vd_mps",
    "roll_deg",
    "pitch_deg",
    "yaw_deg",
    "sigma_n_m",
    "sigma_e_m",
    "sigma_d_m",
    "sigma_v_mps",
    "sigma_yaw_deg",
    "mode",
)


def csv_header() -> str:
    """The line that names the columns, without its end."""
    return ",".join(CSV_COLUMNS)


def csv_row(message: StateMessage) -> str:
    """One line, without its end. Numbers are the shortest that read back as the same float; no state: empty."""
    numbers = _csv_numbers(message.state) if message.state else [""] * (len(CSV_COLUMNS) - 2)
    return ",".join([str(message.t_ns // MICROSECOND), *numbers, message.mode.value])


def _csv_numbers(state: State) -> Iterable[str]:
    numbers = (
        state.lat_deg,
        state.lon_deg,
        state.height_m,
        *state.velocity_ned_mps,
        state.roll_deg,
        state.pitch_deg,
        state.yaw_deg,
        *state.sigma_position_ned_m,
        state.sigma_velocity_mps,
        state.sigma_yaw_deg,
    )
    return map(repr, numbers)
