"""What a configuration will do, in words, and what is odd about it."""

from __future__ import annotations

from collections.abc import Iterator

from fusiond.config.schema import Config, Gnss, Imu, Wheel
from fusiond.events import Vector3

FAR_M = 20.0  # a lever arm beyond this is probably given in other units


def description(config: Config) -> Iterator[str]:
    """The lines of a listing for the person who installs the vehicle."""
    settings, motion = config.filter, config.motion
    yield f"vehicle      {config.vehicle.name}"
    for link, mavlink in config.mavlink.items():
        whose = f"system {mavlink.system}" if mavlink.system else "the first autopilot heard"
        yield f"MAVLink      {link}: {mavlink.connection}, dialect {mavlink.dialect}, {whose}; in replay: a .tlog"
    for bus, can in config.can.items():
        live = ", ".join(filter(None, (can.interface, can.channel, can.config_context))) or "python-can's own settings"
        dbc = ", ".join(can.dbc) or "no DBC"
        yield f"CAN          {bus}: {live}; in a log: channel {can.log_channel or bus}; {dbc}; {can.delay_ms:g} ms old"
    for name, imu in config.imu.items():
        yield from _imu(name, imu)
    for name, gnss in config.gnss.items():
        yield from _gnss(name, gnss)
    for name, wheel in config.wheel.items():
        yield from _wheel(name, wheel)
    for name, barometer in config.barometer.items():
        yield f"barometer    {name}: {barometer.message} of {barometer.link}, {_delay(barometer.delay_ms)}"
        yield f"             sigma {barometer.sigma_m:g} m about a height offset that is learnt"
    constraints = [
        f"no sideways speed at {_place(motion.point_m)} above {motion.minimum_speed_mps:g} m/s" * motion.non_holonomic,
        f"zero velocity and rotation after {motion.still_after_s:g} s at rest" * motion.standstill,
    ]
    yield f"constraints  {'; '.join(filter(None, constraints)) or 'none'}"
    yield f"horizon      {settings.horizon_s:g} s: a measurement up to so late is put where it belongs in time"
    yield f"start        {_start(config)}"
    publish = config.publish
    yield f"publishes    fusiond/{config.vehicle.name}/state at {publish.rate_hz:g} Hz as {publish.encoding}"
    yield f"Zenoh        {_zenoh(config)}"
    if config.mcap.folder is not None:
        yield f"MCAP         files in {config.path(config.mcap.folder)}, {config.mcap.total_mb:g} MB at most"
    if config.foxglove.enabled:
        yield f"Foxglove     ws://{config.foxglove.host}:{config.foxglove.port}"
    if config.prometheus.enabled:
        yield f"Prometheus   http://{config.prometheus.host}:{config.prometheus.port}/metrics"


def _imu(name: str, imu: Imu) -> Iterator[str]:
    yield f"IMU          {name}: {imu.message} of {imu.link}, {_delay(imu.delay_ms)}"
    yield f"             turned by {_three(imu.rotation_deg)} deg (roll, pitch, yaw) against forward-right-down"
    yield f"             noise {imu.accel_noise:g} m/s^2/sqrt(Hz), {imu.gyro_noise:g} rad/s/sqrt(Hz)"


def _gnss(name: str, gnss: Gnss) -> Iterator[str]:
    stamp = "by its own stamp" if gnss.stamp == "sensor" else "by its arrival"
    yield f"GNSS         {name}: {gnss.message} of {gnss.link}, {stamp}, {_delay(gnss.delay_ms)}"
    yield f"             feeds {name}.position: sigma {gnss.position_sigma_m:g} m, in height {gnss.height_sigma_m:g} m"
    if gnss.use_velocity:
        late = _delay(gnss.delay_ms + gnss.velocity_delay_ms)
        yield f"             feeds {name}.velocity: sigma {gnss.velocity_sigma_mps:g} m/s, {late}"
    yield f"             antenna at {_place(gnss.lever_arm_m)} from the IMU"


def _wheel(name: str, wheel: Wheel) -> Iterator[str]:
    where = f"WHEEL_DISTANCE[{wheel.index}] of {wheel.link}"
    if wheel.bus is not None:
        where = f"{wheel.message}.{wheel.signal} of {wheel.bus} in {wheel.unit}"
    yield f"wheel        {name}: {where}, {_delay(wheel.delay_ms)}"
    kind = "steered" if wheel.steered else "not steered"
    sign = "amount only" if wheel.unsigned and not wheel.direction_signal else "with direction"
    factor = f", times {wheel.scale:g}" if wheel.scale != 1 else ""
    yield f"             at {_place(wheel.position_m)}, {kind}, {sign}{factor}, sigma {wheel.sigma_mps:g} m/s"
    guards = [
        f"{signal} {rule}"
        for signal, rule in (
            (wheel.valid_signal, f"must be {wheel.valid_value}"),
            (wheel.counter_signal, "must change"),
            (wheel.checksum, "checksum must be right"),
            (wheel.direction_signal, f"= {wheel.reverse_value} means backwards"),
        )
        if signal
    ]
    if guards:
        yield f"             {', '.join(guards)}"


def _start(config: Config) -> str:
    settings = config.filter
    if settings.heading_deg is not None:
        return f"at rest or in motion, heading {settings.heading_deg:g} +- {settings.heading_sigma_deg:g} deg as given"
    return f"level from gravity, heading from the GNSS course above {settings.course_speed_mps:g} m/s"


def _zenoh(config: Config) -> str:
    zenoh = config.zenoh
    parts: list[str] = [zenoh.mode]
    parts += [f"listens on {', '.join(zenoh.listen)}"] if zenoh.listen else []
    parts += [f"connects to {', '.join(zenoh.connect)}"] if zenoh.connect else []
    parts += [f"file {zenoh.config_file}"] if zenoh.config_file else []
    return ", ".join([*parts, f"multicast scouting {'on' if zenoh.multicast_scouting else 'off'}"])


def _delay(milliseconds: float) -> str:
    return f"true {milliseconds:g} ms before its stamp" if milliseconds else "true at its stamp"


def _place(point_m: Vector3) -> str:
    return f"{_three(point_m)} m (forward, right, down)"


def _three(values: Vector3) -> str:
    return " ".join(f"{value:g}" for value in values)


def oddities(config: Config) -> Iterator[str]:
    """What is allowed, but probably not meant."""
    if not config.gnss:
        yield "no [gnss.NAME]: without a position the filter never starts"
    if not config.wheel:
        yield "no [wheel.NAME]: without GNSS the position will drift with the IMU alone"
    for kind, delay_ms in _delays(config):
        if delay_ms / 1e3 >= config.filter.horizon_s:
            yield (
                f"{kind}: its delay of {delay_ms:g} ms is not below filter.horizon_s ({config.filter.horizon_s:g} s):"
                " all of it will come out too old"
            )
        if delay_ms < 0:
            yield f"{kind}: a delay of {delay_ms:g} ms says that it tells the future"
    for key, point in _points(config):
        if max(map(abs, point)) > FAR_M:
            yield f"{key}: {_place(point)} is far from the IMU; is it in metres?"
        elif not any(point):
            yield f"{key}: 0 0 0 puts it where the IMU is; is it measured?"
    if config.can and all(wheel.bus is None for wheel in config.wheel.values()):
        yield "no [wheel.NAME] uses the [can.NAME] buses: nothing of them will be read"


def _delays(config: Config) -> Iterator[tuple[str, float]]:
    for name, imu in config.imu.items():
        yield f"imu.{name}", imu.delay_ms
    for name, gnss in config.gnss.items():
        yield f"gnss.{name}", gnss.delay_ms
        if gnss.use_velocity:
            yield f"gnss.{name} (velocity)", gnss.delay_ms + gnss.velocity_delay_ms
    for name, wheel in config.wheel.items():
        yield f"wheel.{name}", wheel.delay_ms + (config.can[wheel.bus].delay_ms if wheel.bus else 0.0)


def _points(config: Config) -> Iterator[tuple[str, Vector3]]:
    if config.motion.non_holonomic:
        yield "motion.point_m", config.motion.point_m
    for name, gnss in config.gnss.items():
        yield f"gnss.{name}.lever_arm_m", gnss.lever_arm_m
    for name, wheel in config.wheel.items():
        yield f"wheel.{name}.position_m", wheel.position_m
