"""The sections of the configuration that describe outputs: publication, the black box, and each output."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, field

from fusiond.config.toml import Name, Positive, Section, Vector

Encoding = Literal["json", "msgpack"]
Frame = Annotated[str, Meta(pattern=r"^[^/\s]\S*$", description="a name without blanks, not starting with a slash")]
Namespace = Annotated[
    str,
    Meta(
        pattern=r"^(/|(/[A-Za-z_][A-Za-z0-9_]*)+)$",
        description="a slash, or names that each follow a slash, as /fleet/rover",
    ),
]
SITES = ("https://app.foxglove.dev", "http://localhost:8080")  # Foxglove, and Lichtblick as its container serves it


class Publish(Section, frozen=True, kw_only=True):
    """[publish]"""

    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 50.0  # publications a second, of receive time
    on_imu: bool = False  # each publication waits up to half a period for the next IMU sample
    settled_hz: Annotated[float, Meta(ge=0, le=1000)] = 10.0  # `settled` states a second, at most; 0: none
    innovations: bool = True  # publish the innovation and outcome of every measurement
    encoding: Encoding = "json"  # "json" or "msgpack"


class Zenoh(Section, frozen=True, kw_only=True):
    """[zenoh]: where the state is published. Loopback and no scouting by default."""

    mode: Literal["peer", "client", "router"] = "peer"  # a client needs a router, a peer does not
    listen: list[str] = field(default_factory=lambda: ["tcp/127.0.0.1:7447"])  # endpoints to listen on
    connect: list[str] = field(default_factory=list)  # endpoints to connect to: HOST:PORT, or such as tls/HOST:PORT
    multicast_scouting: bool = False  # discovery on the local network
    config_file: str | None = None  # Zenoh's own configuration file, read before the keys above


class Record(Section, frozen=True, kw_only=True):
    """[record]: the black box of `fusiond run`: all received frames, as .tlog and candump .log."""

    folder: str | None = None  # such as "/var/lib/fusiond/box"; none: nothing is recorded
    file_mb: Annotated[float, Meta(ge=0.01, le=100_000)] = 64.0  # size at which a new file is begun
    total_mb: Annotated[float, Meta(ge=0.02, le=10_000_000)] = 1024.0  # beyond this the oldest files are deleted


class Mcap(Section, frozen=True, kw_only=True):
    """[mcap]: MCAP files of everything published, for Foxglove; needs the extra `mcap`."""

    folder: str | None = None  # such as "/var/lib/fusiond/mcap"; none: nothing is written
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] | None = None  # states a second, at most; none: every one
    file_mb: Annotated[float, Meta(ge=0.5, le=100_000)] = 64.0  # size, about, at which a new file is begun
    total_mb: Annotated[float, Meta(ge=1, le=10_000_000)] = 1024.0  # beyond this the oldest files are deleted


class Foxglove(Section, frozen=True, kw_only=True):
    """[foxglove]: a WebSocket server that Foxglove connects to; needs the extra `foxglove`."""

    enabled: bool = False  # serve
    host: str = "127.0.0.1"  # address to listen on; there is no access control
    port: Annotated[int, Meta(ge=0, le=65535)] = 8765  # TCP port; 0: any that is free
    origins: list[str] = field(default_factory=lambda: list(SITES))  # web sites whose pages may connect; programs always may
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] | None = 20.0  # states a second, at most


class Ros2(Section, frozen=True, kw_only=True):
    """[ros2]: what ROS 2 nodes with rmw_zenoh can subscribe to, without ROS here; needs the extra `ros2`."""

    enabled: bool = False  # publish
    domain: Annotated[int, Meta(ge=0, le=232)] = 0  # ROS_DOMAIN_ID
    namespace: Namespace = "/"  # of the node and its topics
    node: Name = "fusiond"  # name of the node
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 50.0  # states a second, at most
    map_frame: Frame = "map"  # east-north-up at the origin; the pose in it jumps when the filter corrects itself
    odom_frame: Frame = "odom"  # the pose in it drifts, but never jumps
    base_frame: Frame = "base_link"  # at the IMU, with axes forward-left-up
    origin: Vector | None = None  # of the map frame: latitude, longitude [deg], height; none: the first position
    tf: bool = True  # publish the transforms of map, odom and base_link; false where another node does
    type_hashes: bool = True  # as in ROS 2 Iron and later; false for Humble, which has none
    mode: Literal["client", "peer"] = "client"  # a client needs a router (rmw_zenohd), a peer does not
    connect: list[str] = field(default_factory=lambda: ["tcp/127.0.0.1:7447"])  # Zenoh endpoints to connect to
    listen: list[str] = field(default_factory=list)  # Zenoh endpoints to listen on, as a peer
    config_file: str | None = None  # Zenoh's own configuration file, read before the keys above


class Prometheus(Section, frozen=True, kw_only=True):
    """[prometheus]: metrics for Prometheus, over HTTP at /metrics; needs the extra `prometheus`."""

    enabled: bool = False  # serve
    host: str = "127.0.0.1"  # address to listen on; there is no access control
    port: Annotated[int, Meta(ge=0, le=65535)] = 9464  # TCP port; 0: any that is free


class Autopilot(Section, frozen=True, kw_only=True):
    """[autopilot]: the state sent back to the autopilot as an input of its estimator, live; off without a link."""

    link: Name | None = None  # the [mavlink.LINK] of the autopilot; none: nothing is sent
    kind: Literal["ardupilot", "px4"] = "ardupilot"  # the autopilot whose rules the messages follow
    message: Literal["odometry", "gps_input", "vision_position"] = "odometry"  # PX4 does not accept gps_input
    rate_hz: Annotated[float, Meta(ge=4, le=200)] = 30.0  # messages a second; at most publish.rate_hz
    dead_reckoning: bool = True  # send while dead reckoning too, within the limits below
    position_sigma_m: Positive = 5.0  # nothing is sent beyond this horizontal position sigma, north or east
    velocity_sigma_mps: Positive = 1.0  # nor beyond this velocity sigma
    yaw_sigma_deg: Positive = 15.0  # nor beyond this yaw sigma
    age_ms: Positive = 500.0  # nor when the last IMU sample is older
    unconfirmed_heading: bool = False  # send while nothing but a given or stored heading is known: at rest, to arm
    set_origin: bool = False  # send the local origin to the autopilot while it has none of its own
    gps_id: Annotated[int, Meta(ge=0, le=1)] = 1  # the receiver that gps_input stands for: 0 is the first, 1 the second


class GroundStation(Section, frozen=True, kw_only=True):
    """[ground_station]: telemetry, events and answers for a ground station, live; off without link and connection."""

    link: Name | None = None  # send over this [mavlink.LINK]; the autopilot routes it
    connection: str | None = None  # or over a connection of its own, such as "udpout:192.168.1.10:14550"
    baud: Annotated[int, Meta(gt=0)] = 115200  # of that connection, for serial devices
    system: Annotated[int, Meta(ge=0, le=255)] = 0  # own system id on that connection; 0: that of the autopilot
    component: Annotated[int, Meta(ge=1, le=255)] = 191  # own component id on that connection (191: onboard computer)
    rate_hz: Annotated[float, Meta(ge=0.1, le=100)] = 4.0  # position and attitude messages a second
    marker_system: Annotated[int, Meta(ge=0, le=255)] = 0  # system id of a vehicle that marks the state on the map; 0: none
