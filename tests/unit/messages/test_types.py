"""Every field of every message is documented, and every message has a version."""

from __future__ import annotations

import importlib.util
import json

import msgspec

from fusiond.messages.codec import encode
from fusiond.messages.types import MESSAGES, SCHEMA_VERSION, StateMessage
from tests.helpers.paths import ROOT

DOCS = ROOT / "docs"


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
