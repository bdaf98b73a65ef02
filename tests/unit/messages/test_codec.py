"""Encodings keep every bit, and the schema files are current."""

from __future__ import annotations

import json
from typing import get_args

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusiond.config.outputs import Encoding
from fusiond.messages.codec import decode, encode, schemas
from fusiond.messages.types import StateMessage
from tests.helpers.estimates import message, numbers, state
from tests.helpers.paths import ROOT

finite = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e9, max_value=1e9)


@pytest.mark.parametrize("encoding", get_args(Encoding))
@given(x=finite, y=finite, z=finite, variance=st.floats(0, 1e6))
def test_encoding_keeps_every_bit(encoding: Encoding, x: float, y: float, z: float, variance: float) -> None:
    sent = message(state(latitude=x, height=y, velocity_n=(x, y, z), covariance=np.eye(9) * variance))
    got = decode(encode(sent, encoding), StateMessage, encoding)
    assert got == sent
    assert got.state is not None and sent.state is not None
    assert list(map(float.hex, numbers(got.state))) == list(map(float.hex, numbers(sent.state)))


def test_decoding_refuses_garbage_and_passes_over_new_fields() -> None:
    with pytest.raises(msgspec.DecodeError):
        decode(b"{", StateMessage, "json")
    with pytest.raises(msgspec.DecodeError):
        decode(b'{"vehicle": 5}', StateMessage, "json")
    sent = message(state())
    newer = {**json.loads(encode(sent, "json")), "added_later": 1}
    assert decode(json.dumps(newer).encode(), StateMessage, "json") == sent


def test_schema_files_are_up_to_date() -> None:
    kept = {file.name: file.read_bytes() for file in (ROOT / "docs" / "schema").iterdir()}
    assert kept == dict(schemas()), "run: python docs/make_schema.py"
