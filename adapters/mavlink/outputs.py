"""The outputs over MAVLink: the autopilot's, and the ground station's, which can change the rate of the former."""

from __future__ import annotations

from collections.abc import Sequence

from fusiond.config.schema import Config
from fusiond.ports.outputs import Around, LiveOutput
from fusiond_adapters.mavlink.link import link_of


def make(config: Config, around: Around) -> Sequence[LiveOutput]:
    """[autopilot] and [ground_station], where they have a link or a connection."""
    made: list[LiveOutput] = []
    parameters = []
    now = around.clock.now_ns
    if config.autopilot.link is not None:
        from fusiond_adapters.mavlink.autopilot import AutopilotOutput  # noqa: PLC0415 - loads another dialect

        autopilot = AutopilotOutput(config, link_of(around.inputs, config.autopilot.link), now)
        parameters = [autopilot.parameter()]
        made.append(autopilot)
    if config.ground_station.link is not None or config.ground_station.connection is not None:
        from fusiond_adapters.mavlink.ground_station import GroundStation  # noqa: PLC0415

        made.append(GroundStation(config, around.inputs, now, parameters))
    return made
