"""The record of a .tlog: the Unix time of a frame's receipt, then the MAVLink frame."""

from __future__ import annotations

from struct import Struct

from fusiond.units import MICROSECOND

STAMP = Struct(">Q")  # microseconds of Unix time
STAMP_SIZE = STAMP.size


def tlog_record(frame: bytes, t_ns: int) -> bytes:
    """The record of a frame received at `t_ns`."""
    return STAMP.pack(t_ns // MICROSECOND) + frame
