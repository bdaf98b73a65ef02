"""What can be withheld, and how an interval is written."""

from __future__ import annotations

import pytest

from fusiond.app.replay.intervals import parse_interval, parse_withheld
from fusiond.config.schema import Config
from fusiond.errors import UsageError
from tests.helpers.streams import config


@pytest.fixture(scope="module")
def setup() -> Config:
    return config()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("gps9:1-2", "there is no source 'gps9'; configured: gps0, front_left"),
        ("gps0", "give SOURCE:START-STOP"),
        ("gps0:", "is not an interval"),
        ("gps0:5-5", "is not an interval"),
        ("gps0:9-5", "is not an interval"),
        ("gps0:-1-5", "is not an interval"),
        (":1-2", "there is no source ''"),
    ],
)
def test_wrong_intervals_and_sources_are_refused(setup: Config, text: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_withheld(text, setup)
    assert complaint in str(caught.value)


def test_one_stream_of_a_receiver_can_be_withheld(setup: Config) -> None:
    assert parse_withheld("gps0.velocity:0-1.5", setup).sources == {"gps0.velocity"}
    assert parse_interval("12.5-22") == (12.5, 22.0)
