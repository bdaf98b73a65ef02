"""The text of the mounting angles."""

from __future__ import annotations

import math
import re

import numpy as np

from fusiond.app.mounting.report import text
from fusiond.app.mounting.rotation import find
from tests.helpers.mounting import ALL, windows


def test_the_line_for_the_configuration_has_the_rotation_found() -> None:
    found = find(windows(*ALL), (0.0, 0.0, 0.0))
    lines = text(found, "imu0").splitlines()
    assert lines[0] == "[imu.imu0]"
    roll, pitch, yaw = re.findall(r"-?[0-9.]+", lines[1])
    np.testing.assert_allclose(np.radians([float(roll), float(pitch), float(yaw)]), found.rotation, atol=math.radians(0.051))
    assert len([line for line in lines if " deg from the rotation found" in line]) == 3
