"""Checksums in the CAN frames of car makers, as opendbc documents them."""

from __future__ import annotations

from collections.abc import Callable

Check = Callable[[int, bytes], bool]  # arbitration id, data


def _toyota(arbitration_id: int, data: bytes) -> bool:
    """The last byte: length, bytes of the id and the other bytes, summed."""
    total = len(data) + _bytes_of(arbitration_id) + sum(data[:-1])
    return total & 0xFF == data[-1]


def _honda(arbitration_id: int, data: bytes) -> bool:
    """The last four bits: 8 (29-bit ids: 11) less the other half bytes of id and data."""
    total, rest = 0, arbitration_id
    while rest:
        total += rest & 0xF
        rest >>= 4
    total += sum((byte >> 4) + (byte & 0xF) for byte in data[:-1]) + (data[-1] >> 4)
    return (8 + (3 if arbitration_id > 0x7FF else 0) - total) & 0xF == data[-1] & 0xF


def _hyundai(_arbitration_id: int, data: bytes) -> bool:
    """WHL_SPD11: the number of bits set in the four 14-bit speeds, exclusive or 9; in the top bits of bytes 5 and 7."""
    if len(data) != 8:
        return False
    count = sum(bin(byte & (0x3F if place % 2 else 0xFF)).count("1") for place, byte in enumerate(data))
    return (count ^ 9) & 0xF == (data[7] >> 6) << 2 | data[5] >> 6


def _tesla(arbitration_id: int, data: bytes) -> bool:
    """The last byte: bytes of the id and the other bytes, summed."""
    return (_bytes_of(arbitration_id) + sum(data[:-1])) & 0xFF == data[-1]


def _bytes_of(arbitration_id: int) -> int:
    return sum(arbitration_id.to_bytes(4, "big"))


_KINDS: dict[str, Check] = {"toyota": _toyota, "honda": _honda, "hyundai": _hyundai, "tesla": _tesla}


def is_right(kind: str, arbitration_id: int, data: bytes) -> bool:
    """Whether the data ends with the right checksum; `kind` is a value of the configuration."""
    return bool(data) and _KINDS[kind](arbitration_id, data)
