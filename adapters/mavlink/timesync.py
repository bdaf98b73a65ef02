"""TIMESYNC with its extension fields, which pymavlink's dialects lack: the system and the component that it is addressed to.

MAVLink's common.xml has them since 2022. Zero addresses all, as a message without them does.
"""

from __future__ import annotations

from struct import Struct
from typing import Any

from pymavlink.dialects.v20 import common


class Timesync(common.MAVLink_timesync_message):  # type: ignore[misc]
    """A request (`tc1` is 0) or an answer."""

    ordered_fieldnames = ("tc1", "ts1", "target_system", "target_component")
    unpacker = Struct("<qqBB")

    def __init__(self, tc1: int, ts1: int, target_system: int, target_component: int) -> None:
        super().__init__(tc1, ts1)
        self.target_system, self.target_component = target_system, target_component

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The frame from a sender; MAVLink 1 has no extension fields."""
        payload = self.unpacker.pack(self.tc1, self.ts1, self.target_system, self.target_component)
        size = common.MAVLink_timesync_message.unpacker.size if force_mavlink1 else len(payload)
        return bytes(self._pack(mav, self.crc_extra, payload[:size], force_mavlink1=force_mavlink1))
