"""Events: their order, and that they are frozen."""

from __future__ import annotations

import pytest

from fusiond.events import Measurement, WheelSpeed, boot_clock


def test_events_are_ordered_by_stamp_then_source_then_sequence() -> None:
    first = Measurement(1, "rear_left", 9, 60, WheelSpeed(1.0))
    second = Measurement(2, "front_left", 5, 50, WheelSpeed(1.0))
    third = Measurement(2, "rear_left", 0, 40, WheelSpeed(1.0))
    fourth = Measurement(2, "rear_left", 1, 30, WheelSpeed(1.0))
    by_receipt = [fourth, third, second, first]
    assert sorted(by_receipt, key=lambda event: event.key) == [first, second, third, fourth]


def test_events_are_frozen() -> None:
    with pytest.raises(AttributeError):
        WheelSpeed(1.0).speed = 2.0  # type: ignore[misc]


def test_each_system_on_each_link_has_its_own_boot_clock() -> None:
    names = {boot_clock("radio"), boot_clock("radio", 2), boot_clock("serial")}
    assert names == {"radio/1/boot", "radio/2/boot", "serial/1/boot"}
