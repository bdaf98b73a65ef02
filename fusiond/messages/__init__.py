"""The published messages: their types and encodings are here for every reader; how they are made is in the modules."""

from __future__ import annotations

from fusiond.messages.types import *  # noqa: F403
