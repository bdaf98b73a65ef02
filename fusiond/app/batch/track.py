"""The track of one drive as Parquet: one row a published state. Needs the extra `batch`."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

from fusiond.app.batch.table import ParquetFile
from fusiond.app.replay.comparison import Errors
from fusiond.errors import UsageError
from fusiond.messages import StateMessage

try:
    import pyarrow as pa
except ModuleNotFoundError as missing:
    raise UsageError("fusiond batch needs the extra batch: pip install 'fusiond[batch]'") from missing

AT_ONCE = 4096  # rows that are written together

COLUMNS = [
    ("t_ns", pa.int64()),
    ("mode", pa.string()),
    *((name, pa.float64()) for name in (
        "lat_deg", "lon_deg", "height_m", "vn_mps", "ve_mps", "vd_mps", "roll_deg", "pitch_deg", "yaw_deg",
        "sigma_north_m", "sigma_east_m", "sigma_down_m", "error_north_m", "error_east_m", "error_height_m",
    )),
]  # fmt: skip


class TrackFile:
    """Writes a track; a context manager. The file is there when it is complete. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._file = ParquetFile(path, pa.schema(COLUMNS))
        self._rows: list[dict[str, Any]] = []

    def add(self, message: StateMessage, errors: Errors | None) -> None:
        """Add a published state; one without a position is left out."""
        state = message.state
        if state is None:
            return
        north, east, down = state.velocity_ned_mps
        sigma = state.sigma_position_ned_m
        self._rows.append({
            "t_ns": message.t_ns, "mode": message.mode.value, "lat_deg": state.lat_deg, "lon_deg": state.lon_deg,
            "height_m": state.height_m, "vn_mps": north, "ve_mps": east, "vd_mps": down, "roll_deg": state.roll_deg,
            "pitch_deg": state.pitch_deg, "yaw_deg": state.yaw_deg, "sigma_north_m": sigma[0], "sigma_east_m": sigma[1],
            "sigma_down_m": sigma[2], "error_north_m": errors.north_m if errors else None,
            "error_east_m": errors.east_m if errors else None, "error_height_m": errors.height_m if errors else None,
        })  # fmt: skip
        if len(self._rows) == AT_ONCE:
            self._write()

    def _write(self) -> None:
        self._file.write(self._rows)
        self._rows = []

    def __enter__(self) -> TrackFile:
        self._file.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None:
            self._write()
        self._file.__exit__(kind, error, trace)
