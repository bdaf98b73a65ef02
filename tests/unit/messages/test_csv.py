"""The CSV row of a message has its bits."""

from __future__ import annotations

import csv
import json

from fusiond.messages.codec import encode
from fusiond.messages.csv import CSV_COLUMNS, csv_header, csv_row
from tests.helpers.estimates import message, state


def test_csv_row_has_the_bits_of_the_message() -> None:
    sent = message(state())
    row = next(csv.DictReader([csv_header(), csv_row(sent)]))
    wire = json.loads(encode(sent, "json"))["state"]
    assert list(row) == list(CSV_COLUMNS)
    assert row["unix_us"] == "1700000000123456"
    assert row["mode"] == "nominal"
    for column in ("lat_deg", "lon_deg", "height_m", "roll_deg", "pitch_deg", "yaw_deg", "sigma_yaw_deg"):
        assert float(row[column]) == wire[column], column
    assert [float(row[f"v{axis}_mps"]) for axis in "ned"] == wire["velocity_ned_mps"]
    assert [float(row[f"sigma_{axis}_m"]) for axis in "ned"] == wire["sigma_position_ned_m"]
    assert float(row["sigma_v_mps"]) == wire["sigma_velocity_mps"]
