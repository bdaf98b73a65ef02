"""A ground station's output for the tests, with a clock that they set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from pymavlink.dialects.v20 import common

from fusiond.config.schema import Config
from fusiond.ports.inputs import Inbox
from fusiond_adapters.mavlink.answers import Parameter
from fusiond_adapters.mavlink.ground_station import GroundStation
from fusiond_adapters.mavlink.link import MavlinkLink
from tests.helpers.live import configuration
from tests.helpers.mavlink_peers import CLOCK, SYSTEM, Endpoint, UdpListener

STATION, MARKER = 255, 42
STREAMS = ("GLOBAL_POSITION_INT_COV", "LOCAL_POSITION_NED_COV", "ATTITUDE_QUATERNION_COV")
GLOBAL = common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT_COV
SET, GET, REQUEST = 511, 510, 512


class Now:
    """A clock that can be set forward."""

    ahead_ns = 0

    def __call__(self) -> int:
        return CLOCK.now_ns() + self.ahead_ns


def settings_for(connection: str, folder: Path, more: str = "") -> Config:
    own = f'[ground_station]\nconnection = "{connection}"\nsystem = {SYSTEM}\nrate_hz = 25.0\n{more}'
    settings = configuration(folder, "udpin:127.0.0.1:1", own)
    return msgspec.structs.replace(settings, vehicle=msgspec.structs.replace(settings.vehicle, geoid_m=47.5))


def station_at(
    connection: str, folder: Path, more: str = "", parameters: tuple[Parameter, ...] = ()
) -> tuple[GroundStation, Now]:
    settings, now = settings_for(connection, folder, more), Now()
    link = MavlinkLink(settings, "fc", Inbox(16, lambda: None, hash), CLOCK, lambda: True)
    return GroundStation(settings, {"mavlink.fc": link}, now, parameters), now


def from_station(peer: UdpListener) -> Endpoint:
    return Endpoint(peer, STATION, 190)


def long(command: int, *values: float, system: int = SYSTEM, component: int = 191) -> Any:
    return common.MAVLink_command_long_message(system, component, command, 0, *values, *[0.0] * (7 - len(values)))
