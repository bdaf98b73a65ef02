"""Published messages: bits survive encodings and CSV, nothing that is not finite goes out, docs and schema are kept."""

import csv
import dataclasses
import importlib.util
import json
import math
from typing import Any, get_args

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusiond.config.schema import Encoding
from fusiond.estimator.solution import Estimate, Mode, StateEstimate
from fusiond.messages.types import (
    CSV_COLUMNS,
    MESSAGES,
    SCHEMA_VERSION,
    OutcomeCounts,
    State,
    StateMessage,
    csv_header,
    csv_row,
    decode,
    encode,
    schemas,
    state_message,
)
from tests.helpers.paths import ROOT

DOCS = ROOT / "docs"
T_NS = 1_700_000_000_123_456_789
COUNTS = OutcomeCounts(fused=7, rejected=1)

finite = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e9, max_value=1e9)


def state(**changes: Any) -> StateEstimate:
    """A plausible state, with changes."""
    root = np.random.default_rng(3).normal(size=(9, 9)) * 0.1
    values: dict[str, Any] = {
        "latitude": 0.8401,
        "longitude": -2.1,
        "height": 112.3,
        "velocity_n": (1 / 3, -2.5, 0.01),
        "quaternion_nb": quaternion(0.02, -0.03, 3.0),
        "angular_rate_b": (0.01, -0.02, 0.1),
        "acceleration_b": (0.1, 0.2, -9.8),
        "gyro_bias": (1e-3, -2e-4, 1e-7),
        "accel_bias": (0.05, 0.0, -0.1),
        "wheel_scale": 0.012,
        "mount": (0.01, -0.02),
        "covariance": root @ root.T,
        "sigma_gyro_bias": (1e-4, 1e-4, 2e-4),
        "sigma_accel_bias": (1e-2, 1e-2, 2e-2),
        "sigma_wheel_scale": 1e-3,
        "sigma_mount": (1e-3, 2e-3),
    }
    return StateEstimate(**{**values, **changes})


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """The quaternion of Rz(yaw) Ry(pitch) Rx(roll), by multiplying the three."""
    product = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        w, v = product[0], product[1:]
        turn = np.eye(3)[axis] * math.sin(angle / 2)
        c = math.cos(angle / 2)
        product = np.array([w * c - v @ turn, *(w * turn + c * v + np.cross(v, turn))])
    w, x, y, z = product.tolist()
    return w, x, y, z


def message(inner: StateEstimate | None, mode: Mode = Mode.NOMINAL) -> StateMessage:
    return state_message(Estimate(T_NS, mode, age_ns=2_500_000, resets=1, state=inner), "rover", COUNTS)


def numbers(published: State) -> list[float]:
    """Every number of a published state."""
    values = msgspec.structs.astuple(published)
    return [number for value in values for number in (value if isinstance(value, tuple) else (value,))]


@given(st.floats(-math.pi, math.pi), st.floats(-1.57, 1.57), st.floats(-math.pi, math.pi))
def test_euler_angles_come_back(roll: float, pitch: float, yaw: float) -> None:
    found = state(quaternion_nb=quaternion(roll, pitch, yaw)).euler()
    for angle, expected in zip(found, (roll, pitch, yaw), strict=True):
        assert math.isclose(math.remainder(angle - expected, math.tau), 0, abs_tol=1e-9)
        assert -math.pi < angle <= math.pi


def test_south_is_plus_180_degrees_whichever_way_it_is_reached() -> None:
    for z in (1.0, -1.0):
        for w in (0.0, -0.0):
            assert state(quaternion_nb=(w, 0.0, 0.0, z)).euler()[2] == math.pi


def test_straight_up_is_90_degrees_in_spite_of_rounding() -> None:
    half = math.sqrt(0.5) * (1 + 1e-15)
    assert state(quaternion_nb=(half, 0.0, half, 0.0)).euler()[1] == math.pi / 2


def test_covariance_is_a_copy_that_cannot_be_written() -> None:
    original = np.eye(9)
    kept = state(covariance=original)
    original[0, 0] = 5.0
    assert kept.covariance[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        kept.covariance[0, 0] = 2.0
    with pytest.raises(ValueError, match="9 x 9"):
        state(covariance=np.eye(3))


def test_sigmas_and_blocks_are_those_of_the_covariance() -> None:
    covariance = np.diag([4.0, 9.0, 16.0, 1.0, 7.0, 100.0, 1e-4, 1e-4, math.radians(3.0) ** 2])
    covariance[0, 1] = covariance[1, 0] = 0.5
    published = message(state(covariance=covariance)).state
    assert published is not None
    assert published.sigma_position_ned_m == (2.0, 3.0, 4.0)
    assert published.sigma_velocity_mps == 2.0  # of variances 1 and 7; down does not count
    assert published.sigma_yaw_deg == pytest.approx(3.0)
    assert published.covariance_position_m2 == (4.0, 0.5, 0.0, 0.5, 9.0, 0.0, 0.0, 0.0, 16.0)
    assert published.covariance_velocity_m2ps2[8] == 100.0
    assert published.covariance_attitude_rad2[0] == 1e-4


def test_units_of_the_message() -> None:
    published = message(state()).state
    assert published is not None
    assert published.lat_deg == math.degrees(0.8401)
    assert (published.roll_deg, published.pitch_deg, published.yaw_deg) == pytest.approx(np.degrees([0.02, -0.03, 3.0]))
    assert published.mount_deg == (math.degrees(0.01), math.degrees(-0.02))
    assert message(state()).age_ms == 2.5


@pytest.mark.parametrize("encoding", get_args(Encoding))
@given(x=finite, y=finite, z=finite, variance=st.floats(0, 1e6))
def test_encoding_keeps_every_bit(encoding: Encoding, x: float, y: float, z: float, variance: float) -> None:
    sent = message(state(latitude=x, height=y, velocity_n=(x, y, z), covariance=np.eye(9) * variance))
    got = decode(encode(sent, encoding), StateMessage, encoding)
    assert got == sent
    assert got.state is not None and sent.state is not None
    assert list(map(float.hex, numbers(got.state))) == list(map(float.hex, numbers(sent.state)))


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


def test_numpy_numbers_are_published_as_numbers() -> None:
    array = np.array([1.5, 2.5, 3.5])
    sent = message(state(height=array[0], wheel_scale=array[1], velocity_n=tuple(array), mount=tuple(array[:2])))
    assert sent.state is not None and {type(number) for number in numbers(sent.state)} == {float}
    assert csv_row(sent).split(",")[3:6] == ["1.5", "1.5", "2.5"]
    assert decode(encode(sent, "msgpack"), StateMessage, "msgpack") == sent


def test_while_aligning_there_is_no_state() -> None:
    sent = state_message(Estimate(T_NS, Mode.ALIGNING, None, 0, None), "rover", COUNTS)
    assert (sent.state, sent.age_ms, sent.fault) == (None, None, None)
    assert csv_row(sent) == "1700000000123456" + "," * 15 + "aligning"
    assert json.loads(encode(sent, "json"))["state"] is None


VECTORS = [field.name for field in dataclasses.fields(StateEstimate) if field.name != "covariance"]


@pytest.mark.parametrize("name", VECTORS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_withholds_the_state(name: str, bad: float) -> None:
    good = getattr(state(), name)
    sent = message(state(**{name: (bad, *good[1:]) if isinstance(good, tuple) else bad}))
    assert (sent.mode, sent.state) == (Mode.LOST, None)
    assert sent.fault is not None and sent.fault.endswith("not finite")
    for encoding in get_args(Encoding):
        assert decode(encode(sent, encoding), StateMessage, encoding) == sent
    assert csv_row(sent).endswith(",,lost")


@pytest.mark.parametrize(
    ("bad", "place"), [(-1e-9, (4, 4)), (math.nan, (8, 8)), (math.inf, (0, 0)), (math.nan, (0, 1))]
)
def test_a_covariance_that_is_none_withholds_the_state(bad: float, place: tuple[int, int]) -> None:
    covariance = np.eye(9)
    covariance[place] = bad
    sent = message(state(covariance=covariance))
    assert (sent.mode, sent.state) == (Mode.LOST, None)
    assert sent.fault is not None and sent.fault.startswith("covariance")


def test_a_number_too_large_for_its_published_unit_is_withheld() -> None:
    assert message(state(latitude=1e308)).fault == "lat_deg: not finite"


def test_decoding_refuses_garbage_and_passes_over_new_fields() -> None:
    with pytest.raises(msgspec.DecodeError):
        decode(b"{", StateMessage, "json")
    with pytest.raises(msgspec.DecodeError):
        decode(b'{"vehicle": 5}', StateMessage, "json")
    sent = message(state())
    newer = {**json.loads(encode(sent, "json")), "added_later": 1}
    assert decode(json.dumps(newer).encode(), StateMessage, "json") == sent


def test_schema_files_are_up_to_date() -> None:
    kept = {file.name: file.read_bytes() for file in (DOCS / "schema").iterdir()}
    assert kept == dict(schemas()), "run: python docs/make_schema.py"


def test_every_field_is_documented_with_its_meaning() -> None:
    spec = importlib.util.spec_from_file_location("make_schema", DOCS / "make_schema.py")
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    text = (DOCS / "messages.md").read_text(encoding="utf-8")
    assert made.page(text) == text, "run: python docs/make_schema.py"
    for name, kind in MESSAGES.items():
        assert f"{kind.__name__}" in text and f"fusiond/<vehicle>/{name}" in text
    for name, schema in msgspec.json.schema_components(MESSAGES.values())[1].items():
        for field, about in schema.get("properties", {}).items():
            assert f"| `{field}` | {about['description']} |" in text, f"{name}.{field}"


def test_every_message_has_a_version() -> None:
    for kind in MESSAGES.values():
        assert kind.__struct_fields__[0] == "schema"
        assert msgspec.structs.fields(kind)[0].default == SCHEMA_VERSION


def test_the_example_in_the_documentation_is_a_message() -> None:
    text = (DOCS / "messages.md").read_text(encoding="utf-8")
    example = text.split("```json\n")[1].split("```")[0]
    got = msgspec.json.decode(example, type=StateMessage, strict=True)
    assert got.state is not None
    assert json.loads(encode(got, "json")) == json.loads(example)
