"""The public face of the messages: every type of a message can be imported from the package."""

from __future__ import annotations

import fusiond.messages
from fusiond.messages import types


def test_every_message_type_is_public() -> None:
    kinds = {name for name, kind in vars(types).items() if isinstance(kind, type) and issubclass(kind, types.Message)}
    assert len(kinds) > len(types.MESSAGES)
    assert kinds <= set(fusiond.messages.__all__)
    assert {"encode", "decode", "csv_header", "csv_row", "state_message", "Mode"} <= set(fusiond.messages.__all__)
