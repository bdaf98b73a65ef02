"""Transports of links: connection strings, and a line that accepts part of a frame at a time."""

from __future__ import annotations

import pytest

from fusiond_adapters.mavlink.transport import WholeFrames, opener


def test_a_line_that_accepts_parts_gets_whole_frames() -> None:
    got, room = bytearray(), [0]

    def write(data: bytes) -> int:
        if room[0] == 0:
            raise BlockingIOError
        taken = min(room[0], len(data))
        got.extend(data[:taken])
        room[0] -= taken
        return taken

    line = WholeFrames(write)
    frames = [bytes([number]) * 10 for number in range(40)]
    taken = []
    for number, frame in enumerate(frames):
        room[0] += number % 9
        if line.put(frame):
            taken.append(frame)
    room[0] = 100
    assert line.put(b"last")
    assert bytes(got) == b"".join(taken) + b"last"
    assert 5 < len(taken) < 30


@pytest.mark.parametrize(
    "wrong", ["udpin:14550", "tcp:host:port", "carrier:pigeon", "/dev/ttyACM0,fast", "udpin:h:70000", ""]
)
def test_wrong_connection_strings(wrong: str) -> None:
    with pytest.raises(ValueError):
        opener(wrong, 57600)
