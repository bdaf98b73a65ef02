"""The autopilot's own estimate out of each kind of log."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pymavlink.dialects.v20.ardupilotmega as dialect
import pytest

from fusiond.maths.wgs84 import radii
from fusiond.units import MICROSECOND, SECOND
from fusiond_adapters.logs.file import LogError
from fusiond_adapters.logs.own_estimate import OwnState, own_estimate
from tests.helpers.autopilot_logs import FIX_UNIX_S, described, fix, record, ulog
from tests.helpers.logs import START_US, records

NORTH_M = 100.0
LATITUDE = math.radians(48)


def own(path: Path, content: bytes) -> list[OwnState]:
    path.write_bytes(content)
    return list(own_estimate(path))


def estimate(t_us: int, core: int = 0) -> bytes:
    return record("XKF1", TimeUS=t_us, C=core, Yaw=90, VN=1, VE=2, VD=3, PN=NORTH_M, PD=-5)


@pytest.mark.parametrize("origin", [record("ORGN", TimeUS=1, Type=0, Lat=48, Lng=11, Alt=495), fix(11_000_000, Alt=500)])
def test_of_a_bin(tmp_path: Path, origin: bytes) -> None:
    """By the origin that the log gives, or by the fixes."""
    content = described("XKF1", "ORGN", "GPS") + origin + estimate(11_500_000) + estimate(11_500_000, core=1)
    (state,) = own(tmp_path / "a.bin", content)
    by_fix = origin.startswith(b"\xa3\x95\x83")
    assert state.t_ns == (FIX_UNIX_S * SECOND + SECOND + 500_000_000 if by_fix else 11_500_000 * MICROSECOND)
    north = 0.0 if by_fix else NORTH_M / (radii(LATITUDE)[0] + 495)
    assert state.latitude == pytest.approx(LATITUDE + north, abs=1e-9)
    assert (state.longitude, state.height) == pytest.approx((math.radians(11), 500.0))
    assert (state.velocity_n, state.yaw) == ((1.0, 2.0, 3.0), pytest.approx(math.pi / 2))


def test_of_a_tlog(tmp_path: Path) -> None:
    mav = dialect.MAVLink(None, 1, 1)
    message = dialect.MAVLink_global_position_int_message(5, 480_000_000, 110_000_000, 500_000, 0, 100, 200, -300, 9000)
    content = b"".join(records(3)) + struct.pack(">Q", START_US + 30_000) + message.pack(mav)
    (state,) = own(tmp_path / "a.tlog", content)
    assert state == OwnState(
        (START_US + 30_000) * MICROSECOND, LATITUDE, math.radians(11), 500.0, (1.0, 2.0, -3.0), math.pi / 2
    )  # fmt: skip


def test_of_a_ulg(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    fields = "uint64_t timestamp;double ref_lat;double ref_lon;" + "".join(
        f"float {name};" for name in ("ref_alt", "x", "y", "z", "vx", "vy", "vz")
    )
    row = {"timestamp": 2_000_000, "ref_lat": 48.0, "ref_lon": 11.0, "ref_alt": 495.0, "x": NORTH_M, "z": -5.0, "vx": 1.0}
    turned = {"timestamp": 2_000_000, "q[0]": math.sqrt(0.5), "q[3]": math.sqrt(0.5)}
    topics = {"vehicle_local_position": (fields, [row]), "vehicle_attitude": ("uint64_t timestamp;float[4] q;", [turned])}
    (state,) = own(tmp_path / "a.ulg", ulog(topics))
    assert state.latitude == pytest.approx(LATITUDE + NORTH_M / (radii(LATITUDE)[0] + 495), abs=1e-9)
    assert (state.t_ns, state.height, state.yaw) == (2 * SECOND, 500.0, pytest.approx(math.pi / 2))


def test_a_log_without_one(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="own estimate is not in it"):
        own(tmp_path / "a.tlog", b"".join(records(3)))
    with pytest.raises(LogError, match="own estimate is not in it"):
        own(tmp_path / "a.bin", described("GPS") + fix(11_000_000))
    with pytest.raises(LogError, match="no autopilot's estimate is in such a log"):
        own(tmp_path / "a.log", b"x")
