"""Vector BLF with its sizes checked: python-can believes them, reads gigabytes for one, and for a size of 0 never ends.

A BLF is a header, then containers of (mostly compressed) data, in which objects follow each other. What comes out is a BLF
for python-can's reader: uncompressed, in small containers of whole objects, with the objects of CAN alone.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterable, Iterator
from struct import Struct

FILE_HEADER = Struct("<4sL136x")  # signature, size of the header; the rest is passed on
OBJECT = Struct("<4sHHLL")  # signature, size of the header, its version, size of the object, kind
CONTAINER = Struct("<H14x")  # compression
FILE_MAGIC, MAGIC = b"LOGG", b"LOBJ"
CONTAINER_KIND = 10
LEAST_SIZE = {1: 48, 73: 64, 86: 48, 100: 116, 101: 72}  # bytes of an object by kind: messages, errors, FD messages
MOST_SIZE = 1 << 10  # of these kinds: 64 data bytes, and some dozens around them
PADDING = 8  # bytes in which the next object's signature is
UNCOMPRESSED, DEFLATED = 0, 2
PIECE = 1 << 16  # bytes read or uncompressed at a time


class BlfError(ValueError):
    """The content is not a BLF, or is damaged; the message says how."""


def checked(stream: io.BufferedReader) -> Iterator[bytes]:
    """The header, and containers of the objects of CAN. Raises BlfError, zlib.error."""
    head = stream.read(FILE_HEADER.size)
    if len(head) < FILE_HEADER.size or not head.startswith(FILE_MAGIC):
        raise BlfError("it does not start like one")
    _, size = FILE_HEADER.unpack(head)
    if size < FILE_HEADER.size:
        raise BlfError(f"its header claims {size} bytes")
    for _ in _read(stream, size - FILE_HEADER.size):
        pass
    yield head[:4] + FILE_HEADER.size.to_bytes(4, "little") + head[8:]
    for objects in _can_objects(_uncompressed(stream)):
        size = OBJECT.size + CONTAINER.size + len(objects)
        head = OBJECT.pack(MAGIC, OBJECT.size, 1, size, CONTAINER_KIND) + CONTAINER.pack(UNCOMPRESSED)
        yield head + objects + bytes(size % 4)


def _read(stream: io.BufferedReader, size: int) -> Iterator[bytes]:
    """The next bytes, in pieces. Raises BlfError where the file ends before."""
    while size:
        piece = stream.read(min(size, PIECE))
        if not piece:
            raise BlfError(f"it ends {size} bytes before the end of an object")
        size -= len(piece)
        yield piece


def _uncompressed(stream: io.BufferedReader) -> Iterator[bytes]:
    """The content of all containers, in pieces."""
    while head := stream.read(OBJECT.size):
        if len(head) < OBJECT.size or not head.startswith(MAGIC):
            raise BlfError("there is no object where one should begin")
        _, _, _, size, kind = OBJECT.unpack(head)
        if size < OBJECT.size + CONTAINER.size:
            raise BlfError(f"an object claims {size} bytes")
        (compression,) = CONTAINER.unpack(b"".join(_read(stream, CONTAINER.size)))
        content = _read(stream, size - OBJECT.size - CONTAINER.size)
        if kind == CONTAINER_KIND and compression == UNCOMPRESSED:
            yield from content
        elif kind == CONTAINER_KIND and compression == DEFLATED:
            yield from _inflated(content)
        for _ in content:  # of other objects, or after the end of what was compressed
            pass
        stream.read(size % 4)  # padding


def _inflated(packed: Iterable[bytes]) -> Iterator[bytes]:
    inflate = zlib.decompressobj()
    for data in packed:
        piece = inflate.decompress(data, PIECE)
        while piece:
            yield piece
            piece = inflate.decompress(inflate.unconsumed_tail, PIECE)


def _can_objects(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """The whole objects of CAN, those that end in a piece at a time; other kinds are skipped, of whatever size they are."""
    rest, skip = b"", 0  # skip: bytes of an object that are yet to come; there is no rest then
    for piece in pieces:
        data, at, damage = rest + piece[skip:], 0, ""
        skip = max(0, skip - len(piece))
        objects = []
        while (found := data.find(MAGIC, at, at + PADDING)) >= 0 and found + OBJECT.size <= len(data):
            _, _, _, size, kind = OBJECT.unpack_from(data, found)
            if size < OBJECT.size or (kind in LEAST_SIZE and not LEAST_SIZE[kind] <= size <= MOST_SIZE):
                damage = f"an object of kind {kind} claims {size} bytes"
                break
            end = found + size
            if end > len(data):
                if kind not in LEAST_SIZE:
                    at, skip = len(data), end - len(data)
                break
            if kind in LEAST_SIZE:
                objects.append(data[found:end])
            at = end
        if found < 0 and len(data) >= at + PADDING:
            damage = "there is no object where one should begin"
        if objects:
            yield b"".join(objects)
        if damage:
            raise BlfError(damage)
        rest = data[at:]
    if skip or rest.strip(b"\0"):
        raise BlfError("it ends inside an object")
