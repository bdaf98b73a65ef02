"""Transports of links: a line that takes a part of a frame at a time."""

from __future__ import annotations

from fusiond_adapters.mavlink.transport import Whole


def test_a_line_that_takes_parts_gets_whole_frames() -> None:
    got, room = bytearray(), [0]

    def write(data: bytes) -> int:
        if room[0] == 0:
            raise BlockingIOError
        taken = min(room[0], len(data))
        got.extend(data[:taken])
        room[0] -= taken
        return taken

    line = Whole(write)
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
