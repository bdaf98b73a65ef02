"""`fusiond fleet` over a real router: the table, alarms, Prometheus and Foxglove."""

from __future__ import annotations

import asyncio
import io
import json
import time
import urllib.request
from collections.abc import Callable, Iterator
from threading import Event, Thread

import pytest
import websockets
from prometheus_client.parser import text_string_to_metric_families

from fusiond.__main__ import UNUSABLE, main
from fusiond.app.client import Client
from fusiond.app.fleet import terminal
from fusiond.app.fleet.terminal import Address
from fusiond.app.fleet.vehicles import Fleet
from fusiond.app.fleet.view import page, screen
from fusiond.app.top.view import Place, plain
from fusiond.estimator.solution import Mode
from fusiond_adapters.zenoh.session import ZenohPublisher
from tests.helpers.network import DEADLINE
from tests.helpers.vehicles import health, state, yard

NAMES = ("red", "green", "blue")
ANY = Address("127.0.0.1", 0)


def tell(vehicles: dict[str, ZenohPublisher]) -> None:
    for name, vehicle in vehicles.items():
        if name in NAMES:
            vehicle.publish(state(name, Mode.LOST if name == "red" else Mode.NOMINAL))
            vehicle.publish(health(name, gps0="silent" if name == "green" else "nominal"))


def until(condition: Callable[[], bool]) -> None:
    ends = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.02)


@pytest.fixture
def there() -> Iterator[tuple[str, dict[str, ZenohPublisher]]]:
    """A router and three vehicles that go on publishing."""
    stop = Event()
    with yard(NAMES) as (where, vehicles):
        def publish() -> None:
            while not stop.wait(0.1):
                tell(dict(vehicles))

        thread = Thread(target=publish)
        thread.start()
        try:
            yield where, vehicles
        finally:
            stop.set()
            thread.join()


@pytest.fixture
def fleet(there: tuple[str, dict[str, ZenohPublisher]]) -> Iterator[Fleet]:
    with Client(there[0], "*") as client, terminal.listening(client) as found:
        until(lambda: len(found.look().vehicles) == 3 and all(one.state and one.health for one in found.look().vehicles))
        yield found


def test_once_prints_a_line_for_each(
    there: tuple[str, dict[str, ZenohPublisher]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fleet", "--connect", there[0], "--once"]) == 0
    title, heads, *lines = capsys.readouterr().out.splitlines()
    assert title.startswith("3 vehicles  1 lost, 2 nominal  1 critical  1 warning")
    assert heads.startswith("VEHICLE")
    assert [line.split()[0] for line in lines] == ["red", "green", "blue"]
    assert "the state is lost" in lines[0] and "nothing from gps0" in lines[1] and "48.0000000 N" in lines[2]


def test_the_screen_fits_the_terminal(fleet: Fleet) -> None:
    picture, place = fleet.look(), Place()
    lines = page(picture, 60, 4, place)
    assert len(lines) == 4 and all(len(plain(line)) <= 60 for line in lines)
    assert "1-2 of 6 lines" in plain(lines[-1])
    place.press("end", 2)
    assert any("blue" in plain(line) for line in page(picture, 60, 4, place))
    assert len(screen(picture, 200)) == 5


def test_alarms_begin_and_end(fleet: Fleet, there: tuple[str, dict[str, ZenohPublisher]]) -> None:
    out, stop = io.StringIO(), Event()
    thread = Thread(target=terminal.alarms, args=(fleet, out, stop))
    thread.start()
    try:
        until(lambda: out.getvalue().count("\n") == 2)
        gone = there[1].pop("blue")
        gone.close()
        until(lambda: "critical blue gone: " in out.getvalue())
    finally:
        stop.set()
        thread.join()
    lines = [line.partition(" ")[2] for line in out.getvalue().splitlines()]
    assert sorted(lines[:2]) == ["critical red lost: the state is lost", "warning  green source: nothing from gps0"]


def test_metrics_of_the_fleet(fleet: Fleet) -> None:
    with terminal.prometheus(ANY, fleet.look) as url, urllib.request.urlopen(url) as answer:
        text = answer.read().decode()
    found = {
        (sample.name.removeprefix("fusiond_fleet_"), *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert found["vehicles", "nominal"] == 2 and found["vehicles", "lost"] == 1
    assert found["alarms", "lost", "critical"] == 1 and found["alarms", "gone", "critical"] == 0
    assert found["critical", "red"] == 1 and found["critical", "blue"] == 0
    assert found["latitude_degrees", "blue"] == pytest.approx(48.0)
    assert found["states_total", "green"] >= 1 and found["state_age_seconds", "green"] < 5


def test_the_map_has_every_vehicle(fleet: Fleet) -> None:
    async def listened(url: str) -> list[bytes]:
        async with websockets.connect(url, subprotocols=["foxglove.sdk.v1"]) as socket:  # type: ignore[list-item]
            channels = {}
            while len(channels) < 2:
                got = json.loads(await socket.recv())
                if got["op"] == "advertise":
                    channels |= {channel["topic"]: channel["id"] for channel in got["channels"]}
            wanted = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channels["/fleet/vehicles"]}]}
            await socket.send(json.dumps(wanted))
            while not isinstance(data := await asyncio.wait_for(socket.recv(), DEADLINE), bytes):
                pass
            return [data[13:]]

    with terminal.foxglove(ANY, fleet.look) as url:
        (data,) = asyncio.run(listened(url))
    features = json.loads(json.loads(data)["geojson"])["features"]
    assert {one["properties"]["name"]: one["properties"]["alarms"] for one in features} == {
        "red": "the state is lost", "green": "nothing from gps0", "blue": "",
    }  # fmt: skip
    assert all(one["geometry"]["coordinates"] == pytest.approx([11.0, 48.0]) for one in features)


def test_an_unreachable_router_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fleet", "--connect", "127.0.0.1:1", "--once"]) == UNUSABLE
    assert "127.0.0.1:1" in capsys.readouterr().err
