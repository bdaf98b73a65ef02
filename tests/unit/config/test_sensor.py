"""What every kind of sensor declares, and the words for vectors and delays."""

from __future__ import annotations

import pytest

from fusiond.config.schema import Barometer, Wheel, sensor_tables
from fusiond.config.sensor import Sensor, delay_in_words, point_in_words, vector_in_words

KINDS = sensor_tables()
ABSTRACT = [name for name, member in vars(Sensor).items() if getattr(member, "__isabstractmethod__", False)]


@pytest.mark.parametrize("table", KINDS)
def test_every_kind_defines_the_abstract_methods(table: str) -> None:
    assert set(ABSTRACT) == {"streams", "messages", "description"}
    assert not any(getattr(getattr(KINDS[table], name), "__isabstractmethod__", False) for name in ABSTRACT)


def test_inputs_are_the_keys_that_are_set() -> None:
    assert Barometer(link="fc").inputs() == {"link": "fc"}
    assert Wheel(bus="body", message="WHEELS", signal="L").inputs() == {"bus": "body"}


def test_the_origin_is_made_of_messages_and_inputs() -> None:
    assert Barometer(link="fc", message="SCALED_PRESSURE2").origin() == "SCALED_PRESSURE2 of fc"


def test_nothing_contradicts_itself_by_default() -> None:
    assert list(Barometer(link="fc").contradictions()) == []


def test_words_for_vectors_and_delays() -> None:
    assert vector_in_words((1.0, -0.5, 0.25)) == "1 -0.5 0.25"
    assert point_in_words((1.0, -0.5, 0.25)) == "1 -0.5 0.25 m (forward, right, down)"
    assert (delay_in_words(0.0), delay_in_words(2.5)) == ("no delay", "delay 2.5 ms")
