"""The encodings of the messages, JSON and MessagePack, and their JSON Schema."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import msgspec

from fusiond.config.outputs import Encoding
from fusiond.messages.types import MESSAGES, Message

AnyMessage = TypeVar("AnyMessage", bound=Message)

_json = msgspec.json.Encoder()
_msgpack = msgspec.msgpack.Encoder()


def encode(message: Message, encoding: Encoding) -> bytes:
    """The bytes of a message. JSON numbers are the shortest that read back as the same float."""
    return _json.encode(message) if encoding == "json" else _msgpack.encode(message)


def decode(data: bytes, kind: type[AnyMessage], encoding: Encoding) -> AnyMessage:
    """The message in the bytes; unknown fields are ignored. Raises msgspec.DecodeError."""
    return msgspec.json.decode(data, type=kind) if encoding == "json" else msgspec.msgpack.decode(data, type=kind)


def schemas() -> Iterator[tuple[str, bytes]]:
    """File name and text of each message's JSON Schema, as kept in docs/schema/."""
    for name, kind in MESSAGES.items():
        schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **msgspec.json.schema(kind)}
        yield f"{name}.schema.json", msgspec.json.format(msgspec.json.encode(schema), indent=2) + b"\n"
