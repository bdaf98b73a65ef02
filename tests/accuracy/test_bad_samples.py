"""Bad inertial samples put into captured drives: single ones do no harm; and none of what was captured is taken for one."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fusiond.config import load as configuration
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.events import ImuSample, Measurement, Vector3
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import ecef
from fusiond.timeline.clock import Clock
from fusiond.units import SECOND
from fusiond_adapters.logs.merge import open_logs
from tests.conftest import needs_compiled
from tests.helpers.paths import ROOT

DATA = ROOT.parent / "shared" / "data"
DRIVES = {
    "comma2k19-rav4": (ROOT / "configs" / "rav4.toml", ("drive.tlog", "drive.candump.log"), 30.0),
    "everett-rtk": (DATA / "everett-rtk" / "drive.toml", ("drive.tlog",), 100.0),
    "husky": (DATA / "husky" / "drive.toml", ("drive.tlog", "drive.log"), 395.0),
}
BAD: dict[str, tuple[tuple[float | None, ...], tuple[float | None, ...]]] = {  # force, rate; None: as it was
    "gyro x": ((None, None, None), (5.0, None, None)),
    "gyro z": ((None, None, None), (None, None, 5.0)),
    "all gyros": ((None, None, None), (34.9, 34.9, 34.9)),
    "all accelerometers": ((159.0, 159.0, 159.0), (None, None, None)),
}
WORST_M = 0.5
LATER = 3  # positions by which a start may be later, if a bad sample falls into it
pytestmark = [
    pytest.mark.skipif(not DATA.is_dir(), reason="the captured drives are not beside the project"),
    needs_compiled,
]


@cache
def captured(name: str) -> tuple[Config, tuple[Measurement, ...]]:
    """The configuration and the events of a captured drive, in the order of their stamps."""
    path, logs, until_s = DRIVES[name]
    config = configuration.load(path)
    clock, found = Clock(config), []
    for received in open_logs([Path(DATA / name / log) for log in logs], config):
        event = clock.align(received)
        if event is not None:
            found.append(event)
    found.sort(key=lambda event: event.key)
    end_ns = found[0].t_ns + round(until_s * SECOND)
    return config, tuple(event for event in found if event.t_ns < end_ns)


def track(config: Config, events: list[Measurement]) -> tuple[dict[int, Array], Fusion]:
    """Positions (3,) [m], earth-fixed, ten a second."""
    fusion, places, tick_ns = Fusion(config), {}, SECOND // 10
    for event in events:
        due = event.t_ns // tick_ns * tick_ns
        if due not in places:
            state = fusion.solution_at(due).state
            if state is not None:
                places[due] = np.array(ecef(state.latitude, state.longitude, state.height))
        fusion.fuse(event)
    return places, fusion


def replaced(vector: Vector3, by: tuple[float | None, ...]) -> Vector3:
    x, y, z = (old if new is None else new for old, new in zip(vector, by, strict=True))
    return x, y, z


def spoiled(events: tuple[Measurement, ...], kind: str, every_s: float) -> tuple[list[Measurement], int]:
    """The events with one bad inertial sample every so many seconds; how many."""
    force, rate = BAD[kind]
    first_ns = next(event.t_ns for event in events if isinstance(event.payload, ImuSample))
    made, due, count = list(events), first_ns + round(every_s * SECOND), 0
    for i, event in enumerate(events):
        if isinstance(event.payload, ImuSample) and event.t_ns >= due:
            now = event.payload
            lie = ImuSample(replaced(now.specific_force_b, force), replaced(now.angular_rate_b, rate))
            made[i] = msgspec.structs.replace(event, payload=lie)
            due += round(every_s * SECOND)
            count += 1
    return made, count


@pytest.mark.parametrize("name", DRIVES)
def test_no_captured_sample_is_rejected(name: str) -> None:
    config, events = captured(name)
    imu = track(config, list(events))[1].outcomes()["imu0"]
    assert imu["REJECTED"] == 0
    assert imu["FUSED"] > 2500


@pytest.mark.parametrize("name", ["comma2k19-rav4", "everett-rtk"])
@pytest.mark.parametrize("kind", BAD)
def test_single_bad_samples_do_no_harm(name: str, kind: str) -> None:
    config, events = captured(name)
    bad, count = spoiled(events, kind, 3.1)
    before, _ = track(config, list(events))
    after, fusion = track(config, bad)
    assert fusion.outcomes()["imu0"]["REJECTED"] == count
    first = sorted(before).index(min(after))
    assert first <= LATER
    assert sorted(after) == sorted(before)[first:]
    assert max(float(np.linalg.norm(before[t] - after[t])) for t in after) < WORST_M
