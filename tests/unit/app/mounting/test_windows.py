"""The windows of a drive: what is missing, and gaps."""

from __future__ import annotations

import pytest

from fusiond.app.mounting.rotation import find
from fusiond.app.mounting.windows import WINDOW, Gathering, MountingError
from fusiond.events import Invalid, Measurement
from fusiond.maths.rotation import matrix_from_euler
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
