"""Where the configuration of a command may stand, and how much is told."""

from __future__ import annotations

import argparse
import logging

import pytest

from fusiond.app.commands.arguments import add_config, add_config_and_logs, add_verbosity, log_level, taken_config
from fusiond.errors import UsageError


def parsed(*words: str, logs: bool = True) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    (add_config_and_logs if logs else add_config)(parser)
    add_verbosity(parser, quiet="less", verbose="more")
    return parser.parse_args(words)


@pytest.mark.parametrize(
    "words", [("car.toml", "a.tlog", "b.log"), ("a.tlog", "b.log", "--config", "car.toml"), ("a.tlog", "car.toml", "b.log")]
)
def test_the_configuration_may_stand_among_the_logs(words: tuple[str, ...]) -> None:
    arguments = parsed(*words)
    assert taken_config(arguments) == "car.toml"
    assert arguments.logs == ["a.tlog", "b.log"]


@pytest.mark.parametrize("words", [("car.toml",), ("--config", "car.toml"), ("--config", "/dev/stdin")])
def test_alone(words: tuple[str, ...]) -> None:
    assert taken_config(parsed(*words, logs=False)) == words[-1]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("a.tlog",), "one configuration is needed: give its name"),
        (("a.toml", "b.toml", "a.tlog"), "found a.toml and b.toml"),
        (("a.toml", "a.tlog", "--config", "b.toml"), "found a.toml and b.toml"),
        (("a.toml",), "a.toml is the configuration: give a log as well"),
    ],
)
def test_what_is_missing_or_too_much(words: tuple[str, ...], complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        taken_config(parsed(*words))


def test_without_a_configuration() -> None:
    with pytest.raises(UsageError, match="one configuration is needed"):
        taken_config(parsed(logs=False))


def test_how_much_is_logged() -> None:
    levels = [log_level(parsed("a.toml", *words, logs=False)) for words in ((), ("-q",), ("--verbose",))]
    assert levels == [logging.INFO, logging.WARNING, logging.DEBUG]
