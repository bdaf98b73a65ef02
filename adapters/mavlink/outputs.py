"""The outputs over MAVLink: to the autopilot, and to the ground station, which can change the rate of the first."""

from __future__ import annotations

from collections.abc import Sequence

from fusiond.config.schema import Config
from fusiond.ports.outputs import LiveOutput, OutputContext
from fusiond_adapters.mavlink.link import link_of


def make(config: Config, context: OutputContext) -> Sequence[LiveOutput]:
    """[autopilot] and [ground_station], where they have a link or a connection."""
    made: list[LiveOutput] = []
    parameters = []
    now = context.clock.now_ns
    if config.autopilot.link is not None:
        from fusiond_adapters.mavlink.autopilot import AutopilotOutput  # noqa: PLC0415 - loads another dialect

        autopilot = AutopilotOutput(config, link_of(context.inputs, config.autopilot.link), now, context.frame)
        parameters = [autopilot.parameter()]
        made.append(autopilot)
    if config.ground_station.link is not None or config.ground_station.connection is not None:
        from fusiond_adapters.mavlink.ground_station import GroundStation  # noqa: PLC0415

        made.append(GroundStation(config, context.inputs, now, parameters))
    return made
