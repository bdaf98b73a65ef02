"""The windows of a drive: what is missing, and gaps."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from fusiond.app.mounting.rotation import find
from fusiond.app.mounting.windows import WINDOW, Gathering, MountingError
from fusiond.events import Invalid, Measurement
from fusiond.maths.rotation import matrix_from_euler
from fusiond.units import SECOND
from tests.helpers.mounting import WITHIN, angle_of, events, settings


def test_the_error_names_what_is_missing() -> None:
    gathering = Gathering(settings())
    with pytest.raises(MountingError, match="no sample of the inertial sensor"):
        gathering.windows()
    imu = [event for event in events() if event.source == "imu0"]
    for event in imu:
        gathering.add(event)
    gathering.add(Measurement(imu[0].t_ns, "gps0.velocity", 0, imu[0].t_ns, Invalid("no fix")))
    with pytest.raises(MountingError, match="the speed is known from wheels or GNSS for 0 s only; 10 s are needed"):
        gathering.windows()
    assert gathering.elapsed_ns == pytest.approx(45e9, abs=1e9)


def test_gaps_are_left_out() -> None:
    """Without the IMU for two seconds, and without any speed for three."""
    gathering = Gathering(settings())
    begin = events()[0].t_ns
    for event in events():
        second = (event.t_ns - begin) * 1e-9
        if (event.source == "imu0" and 20 < second < 22) or (event.source != "imu0" and 30 < second < 33):
            continue
        gathering.add(event)
    drive = gathering.windows()
    assert 45 - 10 <= len(drive.number) * WINDOW <= 45 - 5
    assert angle_of(matrix_from_euler(*find(drive, (0.0, 0.0, 0.0)).rotation)) < WITHIN


def test_a_second_session_at_the_same_time_is_not_mixed_with_the_first() -> None:
    """The clock of the host is set back by 20 s in the middle of the drive."""
    gathering = Gathering(settings())
    half, begun = events()[len(events()) // 2].t_receive_ns, False
    for event in events():
        if event.t_receive_ns < half:
            gathering.add(event)
            continue
        if not begun:
            gathering.begin_session(event.t_receive_ns - 20 * SECOND)
            begun = True
        gathering.add(replace(event, t_ns=event.t_ns - 20 * SECOND, t_receive_ns=event.t_receive_ns - 20 * SECOND))
    drive = gathering.windows()
    assert 45 - 5 <= len(drive.number) * WINDOW <= 45
    assert angle_of(matrix_from_euler(*find(drive, (0.0, 0.0, 0.0)).rotation)) < WITHIN
