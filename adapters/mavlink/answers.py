"""Answers to the MAVLink command and parameter protocols. No I/O.

Commands: MAV_CMD_REQUEST_MESSAGE, MAV_CMD_SET_MESSAGE_INTERVAL and MAV_CMD_GET_MESSAGE_INTERVAL, for the messages that are
sent here. Other commands to our component are answered with "unsupported"; a command to all components is answered only if
it can be executed. Parameters are single floats; a rejected value is answered with the present one, as the protocol demands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common

from fusiond import __version__
from fusiond_adapters.mavlink.outgoing import RateLimiter

COMMANDS = (common.MAV_CMD_REQUEST_MESSAGE, common.MAV_CMD_SET_MESSAGE_INTERVAL, common.MAV_CMD_GET_MESSAGE_INTERVAL)
STOP, DEFAULT = -1, 0  # intervals of MAV_CMD_SET_MESSAGE_INTERVAL; others are microseconds
MAX_INTERVAL_US = 2**31 - 1  # what MESSAGE_INTERVAL can say
BY_NAME = -1  # PARAM_REQUEST_READ.param_index
CAPABILITIES = (
    common.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | common.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | common.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
)  # fmt: skip
HANDLED = {
    common.MAVLINK_MSG_ID_COMMAND_LONG,
    common.MAVLINK_MSG_ID_COMMAND_INT,
    common.MAVLINK_MSG_ID_PARAM_REQUEST_LIST,
    common.MAVLINK_MSG_ID_PARAM_REQUEST_READ,
    common.MAVLINK_MSG_ID_PARAM_SET,
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter, set by `put` to numbers from `minimum` to `maximum`; without `put` it is read-only."""

    name: str  # at most 16 characters
    get: Callable[[], float]
    put: Callable[[float], None] | None = None
    minimum: float = -math.inf
    maximum: float = math.inf

    def set(self, value: float) -> bool:
        """Set it if that is allowed. Whether it was."""
        if self.put is None or not self.minimum <= value <= self.maximum:
            return False
        self.put(value)
        return True


class Responder:
    """Answers commands and parameter requests. `limiters` has the rate limiter of each message sent here, by message id;
    commands change their rates. Messages requested once stay in `requested` until their sender removes them."""

    def __init__(self, parameters: Sequence[Parameter], limiters: Mapping[int, RateLimiter]) -> None:
        self.requested: set[int] = set()
        self._parameters = parameters
        self._limiters = limiters
        self._default_hz = {number: limiter.rate_hz for number, limiter in limiters.items()}

    def answers(self, message: Any, us: tuple[int, int]) -> Iterator[Any]:
        """The answers to a message (one of HANDLED) as `us`: system, component; none if it is not addressed to us."""
        if message.target_system not in (0, us[0]) or message.target_component not in (0, us[1]):
            return
        kind = message.get_msgId()
        if kind in (common.MAVLINK_MSG_ID_COMMAND_LONG, common.MAVLINK_MSG_ID_COMMAND_INT):
            yield from self._command_answers(message, us)
        elif kind == common.MAVLINK_MSG_ID_PARAM_REQUEST_LIST:
            yield from map(self._value, range(len(self._parameters)))
        else:
            index = self._find(message)
            if index is not None:
                if kind == common.MAVLINK_MSG_ID_PARAM_SET:
                    self._parameters[index].set(message.param_value)
                yield self._value(index)

    # --- Commands

    def _command_answers(self, message: Any, us: tuple[int, int]) -> Iterator[Any]:
        command = message.command
        known = command in COMMANDS and _whole(message.param1)
        number = int(message.param1) if known else -1
        addressed = message.target_component == us[1]
        if not addressed and not (known and number in self._limiters):
            return
        result, further = self._execute(command, number, message.param2) if known else (common.MAV_RESULT_UNSUPPORTED, None)
        sender = message.get_srcSystem(), message.get_srcComponent()
        yield common.MAVLink_command_ack_message(command, result, 0, 0, *sender)
        if further is not None:
            yield further

    def _execute(self, command: int, number: int, value: float) -> tuple[int, Any]:
        """MAV_RESULT, and a message to send after it."""
        if command == common.MAV_CMD_REQUEST_MESSAGE and number == common.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            return common.MAV_RESULT_ACCEPTED, _version()
        limiter = self._limiters.get(number)
        if limiter is None:
            return common.MAV_RESULT_UNSUPPORTED, None
        if command == common.MAV_CMD_REQUEST_MESSAGE:
            self.requested.add(number)
            return common.MAV_RESULT_ACCEPTED, None
        if command == common.MAV_CMD_GET_MESSAGE_INTERVAL:
            interval = round(1e6 / limiter.rate_hz) if limiter.rate_hz else -1
            return common.MAV_RESULT_ACCEPTED, common.MAVLink_message_interval_message(number, interval)
        if not (value in (STOP, DEFAULT) or 1 <= value <= MAX_INTERVAL_US):
            return common.MAV_RESULT_DENIED, None
        limiter.rate_hz = 0.0 if value == STOP else self._default_hz[number] if value == DEFAULT else 1e6 / value
        return common.MAV_RESULT_ACCEPTED, None

    # --- Parameters

    def _find(self, message: Any) -> int | None:
        index: int = getattr(message, "param_index", BY_NAME)
        if index != BY_NAME:
            return index if 0 <= index < len(self._parameters) else None
        names = [parameter.name for parameter in self._parameters]
        name = message.param_id.rstrip("\0")
        return names.index(name) if name in names else None

    def _value(self, index: int) -> Any:
        parameter = self._parameters[index]
        return common.MAVLink_param_value_message(
            parameter.name.encode(), parameter.get(), common.MAV_PARAM_TYPE_REAL32, len(self._parameters), index
        )


def _whole(number: float) -> bool:
    return math.isfinite(number) and number == int(number)


def _version() -> Any:
    major, minor, patch = (int(part) for part in __version__.split(".")[:3])
    number = major << 24 | minor << 16 | patch << 8
    return common.MAVLink_autopilot_version_message(
        CAPABILITIES, number, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0
    )
