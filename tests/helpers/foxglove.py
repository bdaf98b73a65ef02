"""States with a place, and what Foxglove calls a plain field."""

from __future__ import annotations

from typing import Any

from fusiond.messages.types import StateMessage
from tests.helpers.drive import messages

PLAIN = {"number", "integer", "string", "boolean"}


def states() -> list[StateMessage]:
    return [message for message in messages() if isinstance(message, StateMessage) and message.state is not None]


def fields(schema: dict[str, Any], path: str) -> dict[str, Any]:
    """The schema at a message path such as `.state.sigma[0]`. KeyError where there is no such field."""
    for part in filter(None, path.split(".")):
        name, _, index = part.partition("[")
        schema = schema["properties"][name]
        schema = schema["items"] if index else schema
    return schema
