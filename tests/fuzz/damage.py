"""Damage to bytes and to MAVLink frames, by dice: what lines, disks and attackers do."""

from __future__ import annotations

import random
import re
import struct
from typing import Any

from fastcrc.crc16 import mcrf4xx

ODD_NUMBERS = (0, 1, 2, *((1 << bits) + more for bits in (7, 8, 15, 16, 31, 32, 63) for more in (-1, 0)), (1 << 64) - 1)
ODD_FLOATS = (float("nan"), float("inf"), float("-inf"), 0.0, -0.0, 1e-45, 1e-30, 1e6, 1e30, 3.4e38, -3.4e38)
DIGITS, WORD = re.compile(rb"-?[0-9]+(?:\.[0-9]+)?"), re.compile(rb"[A-Za-z_]\w+")
NUMBERS = (b"0", b"-1", b"1e400", b"-0.0", b"64", b"65", b"255", b"4294967296", b"9" * 20, b"1e-300", b"nan", b"")
PUNCTUATION = tuple(bytes((code,)) for code in b" \n\t|@:;,.=+-()[]{}\"'#_")
WORDS = (b"nan", b"1e400", b"-1", b"9" * 40, b"0x", b"\0", b"\xff\xfe", b"[", b"{", b'"', b"=", b",", b";", b"#", b"\r\n")


def damaged_text(data: bytes, dice: random.Random, most: int = 4) -> bytes:
    """A text with at least one and at most so many faults, mostly of characters that a text may have."""
    found = bytearray(data)
    for _ in range(dice.randint(1, most)):
        at, size = dice.randrange(len(found) + 1), dice.randrange(1, 9)
        if (number := DIGITS.search(found, at)) and dice.random() < 0.5:
            found[number.start() : number.end()] = dice.choice(NUMBERS)
        elif (word := WORD.search(found, at)) and dice.random() < 0.5:
            other = WORD.search(found, dice.randrange(len(found)))
            found[word.start() : word.end()] = other[0] if other and dice.random() < 0.5 else b""
        elif dice.random() < 0.5:
            found[at : at + size] = b""
        else:
            found[at : at + dice.randrange(2)] = dice.choice((*WORDS, *PUNCTUATION))
    return bytes(found)


def damaged(data: bytes, dice: random.Random, most: int = 4) -> bytes:
    """The data with at least one and at most so many faults."""
    found = bytearray(data)
    for _ in range(dice.randint(1, most)):
        at = dice.randrange(len(found) + 1)
        kind = dice.randrange(8)
        if kind == 0 and at < len(found):
            found[at] ^= 1 << dice.randrange(8)
        elif kind == 1 and at < len(found):
            found[at] = dice.randrange(256)
        elif kind == 2:
            del found[at : at + dice.randrange(1, 9)]
        elif kind == 3:
            found[at:at] = dice.randbytes(dice.randrange(1, 9))
        elif kind == 4:
            number = dice.choice(ODD_NUMBERS).to_bytes(8, dice.choice(("little", "big")))
            size = dice.choice((1, 2, 4, 8))
            found[at : at + size] = number[:size]
        elif kind == 5:
            found[at:at] = dice.choice(WORDS)
        elif kind == 6:  # a part again, elsewhere
            begin = dice.randrange(len(found) + 1)
            found[at:at] = found[begin : begin + dice.randrange(1, 65)]
        elif dice.random() < 0.2:
            del found[at:]
    return bytes(found)


def frame(kind: Any, payload: bytes, dice: random.Random, system: int, component: int) -> bytes:
    """A MAVLink 2 frame with a right checksum. `kind` is pymavlink's class of the message."""
    payload = payload[:255].rstrip(b"\0") or b"\0"
    head: bytes = bytes((len(payload), 0, 0, dice.randrange(256), system, component)) + kind.id.to_bytes(3, "little")
    checksum: int = mcrf4xx(head + payload + bytes((kind.crc_extra,)))
    return b"\xfd" + head + payload + checksum.to_bytes(2, "little")


def odd_frame(kinds: list[Any], dice: random.Random) -> bytes:
    """A sound frame of any message, mostly from the autopilot, with odd values in its fields."""
    kind = dice.choice(kinds)
    values: list[Any] = []
    for code in kind.unpacker.format.lstrip("<>="):
        if code in "fd":
            values.append(dice.choice(ODD_FLOATS) if dice.random() < 0.5 else dice.uniform(-100.0, 100.0))
        elif code in "bBhHiIqQ":
            bits = 8 * struct.calcsize(f"<{code}")
            number = dice.choice(ODD_NUMBERS) if dice.random() < 0.5 else dice.getrandbits(bits)
            number &= (1 << bits) - 1
            values.append(number - (1 << bits) if code.islower() and number >> bits - 1 else number)
        else:  # an array
            return frame(kind, dice.randbytes(kind.unpacker.size), dice, 1, 1)
    system, component = (1, 1) if dice.random() < 0.7 else (dice.randrange(256), dice.randrange(256))
    payload: bytes = kind.unpacker.pack(*values)
    return frame(kind, payload, dice, system, component)
