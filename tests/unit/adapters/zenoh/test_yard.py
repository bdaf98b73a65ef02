"""The sample router of a yard: it is what its script makes, vehicles keep to their names, and slow readers are thinned."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import zenoh

from fusiond.app.client import Client
from fusiond.config.outputs import Zenoh
from fusiond.messages.types import EventMessage, StateMessage
from fusiond_adapters.zenoh.session import ZenohPublisher, open_session, session_config
from tests.helpers.certificates import certify
from tests.helpers.paths import ROOT
from tests.helpers.vehicles import state
from tests.helpers.zenoh import endpoint, sees

SAMPLES = ROOT / "configs" / "zenoh"
PLACE = "/etc/fusiond/zenoh"
STATES, PAUSE_S = 60, 0.05


def made(*arguments: str) -> str:
    command = [sys.executable, str(SAMPLES / "yard.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_the_sample_is_what_the_script_makes() -> None:
    assert made("--slow", "wlan0", "van01", "van02") == (SAMPLES / "yard.json5").read_text()


def test_a_yard_of_hundreds_is_one_file(tmp_path: Path) -> None:
    (tmp_path / "yard.json5").write_text(made(*(f"van{number:03d}" for number in range(300))))
    config = zenoh.Config.from_file(tmp_path / "yard.json5")
    assert len(json.loads(config.get_json("access_control/rules"))) == 303


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("openssl") is None:
        pytest.skip("makes its certificates with openssl")
    path = tmp_path_factory.mktemp("yard")
    certify(path, "router", "van01", "van02", "reader")
    (path / "yard.json5").write_text(made("--slow", "lo", "van01", "van02").replace(PLACE, str(path)))
    (path / "reader.json5").write_text((SAMPLES / "reader.json5").read_text().replace(PLACE, str(path)))
    for name in ("van01", "van02"):
        text = (SAMPLES / "vehicle.json5").read_text().replace(PLACE, str(path)).replace("rover", name)
        (path / f"{name}.json5").write_text(text)
    return path


def test_vehicles_keep_to_their_names_and_slow_readers_are_thinned(folder: Path) -> None:
    where = endpoint().replace("tcp/", "tls/")
    router = session_config(Zenoh(mode="router", listen=[where], config_file="yard.json5"), folder)
    heard: Counter[str] = Counter()
    events: list[str] = []

    def count(message: StateMessage) -> None:
        heard[message.vehicle] += 1

    def vehicle(name: str) -> Zenoh:
        return Zenoh(mode="client", listen=[], connect=[where], config_file=f"{name}.json5")

    with (
        zenoh.open(router),
        open_session(vehicle("van01"), folder) as first,
        open_session(vehicle("van02"), folder) as second,
        ZenohPublisher(first, "van01", "json") as van,
        ZenohPublisher(second, "van01", "json") as forger,
        Client(where, "*", config_file=folder / "reader.json5") as client,
        client.subscribed(StateMessage, count),
        client.subscribed(EventMessage, lambda message: events.append(message.text)),
    ):
        assert sees(client, "van01")
        forger.publish(event("forged"))
        for _ in range(STATES):
            van.publish(state("van01"))
            time.sleep(PAUSE_S)
        van.publish(event("true"))
        ends = time.monotonic() + 15.0
        while "true" not in events and time.monotonic() < ends:
            time.sleep(0.05)
    assert events == ["true"]
    assert set(heard) == {"van01"} and 2 <= heard["van01"] <= STATES // 4  # one a second of twenty


def event(text: str) -> EventMessage:
    return EventMessage(vehicle="van01", t_ns=1, kind="mode", severity="info", subject="nominal", text=text)
