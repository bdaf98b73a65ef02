"""Every output there is: a factory each, which makes none, one or several of them, as the configuration asks.

A factory imports its adapter only when the configuration asks for it, so that nobody pays for what is off.
"""

from __future__ import annotations

from collections.abc import Sequence

from fusiond.config.schema import Config
from fusiond.ports.outputs import Around, Factory, LiveOutput


def zenoh(config: Config, _: Around) -> Sequence[LiveOutput]:
    """[zenoh]: always there, as everything else that reads fusiond reads it there."""
    from fusiond_adapters.zenoh.output import ZenohOutput  # noqa: PLC0415

    return [ZenohOutput(config)]


def ros2(config: Config, _: Around) -> Sequence[LiveOutput]:
    """[ros2], where enabled."""
    if not config.ros2.enabled:
        return []
    from fusiond_adapters.ros2.output import Ros2Output  # noqa: PLC0415

    return [Ros2Output(config)]


def mcap(config: Config, _: Around) -> Sequence[LiveOutput]:
    """[mcap], where it has a folder."""
    if config.mcap.folder is None:
        return []
    from fusiond_adapters.mcap import McapRecorder  # noqa: PLC0415

    return [McapRecorder(config, config.path(config.mcap.folder))]


def foxglove(config: Config, _: Around) -> Sequence[LiveOutput]:
    """[foxglove], where enabled."""
    if not config.foxglove.enabled:
        return []
    from fusiond_adapters.foxglove.server import FoxgloveServer  # noqa: PLC0415

    return [FoxgloveServer(config)]


def prometheus(config: Config, _: Around) -> Sequence[LiveOutput]:
    """[prometheus], where enabled."""
    if not config.prometheus.enabled:
        return []
    from fusiond_adapters.prometheus import PrometheusServer  # noqa: PLC0415

    return [PrometheusServer(config)]


def mavlink(config: Config, around: Around) -> Sequence[LiveOutput]:
    """[autopilot] and [ground_station], where they have a link or a connection; the latter offers the former's rate."""
    made: list[LiveOutput] = []
    parameters = []
    now = around.clock.now_ns
    if config.autopilot.link is not None:
        from fusiond_adapters.mavlink.autopilot import AutopilotOutput  # noqa: PLC0415
        from fusiond_adapters.mavlink.link import link_of  # noqa: PLC0415

        autopilot = AutopilotOutput(config, link_of(around.inputs, config.autopilot.link), now)
        parameters = [autopilot.parameter()]
        made.append(autopilot)
    if config.ground_station.link is not None or config.ground_station.connection is not None:
        from fusiond_adapters.mavlink.ground_station import GroundStation  # noqa: PLC0415

        made.append(GroundStation(config, around.inputs, now, parameters))
    return made


OUTPUTS: tuple[Factory, ...] = (zenoh, ros2, mcap, foxglove, prometheus, mavlink)


def make_outputs(config: Config, around: Around) -> dict[str, LiveOutput]:
    """The outputs of a configuration, by name. Raises ConfigError."""
    return {output.name: output for factory in OUTPUTS for output in factory(config, around)}
