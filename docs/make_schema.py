"""Write the JSON Schema of every published message into docs/schema/, and the tables of fields into docs/messages.md:
python docs/make_schema.py"""

import re
from pathlib import Path
from typing import Any

import msgspec

from fusiond.messages.codec import schemas
from fusiond.messages.types import MESSAGES

FOLDER = Path(__file__).parent / "schema"
PAGE = Path(__file__).parent / "messages.md"
TABLE = re.compile(r"(<!-- fields of (\w+) -->\n).*?(<!-- end -->\n)", re.DOTALL)


def page(text: str) -> str:
    """The text of messages.md, with its tables renewed."""
    definitions: dict[str, Any] = msgspec.json.schema_components(MESSAGES.values())[1]

    def table(found: re.Match[str]) -> str:
        rows = [
            f"| `{name}` | {field['description']} |\n" for name, field in definitions[found[2]]["properties"].items()
        ]
        return found[1] + "\n| field | meaning |\n|---|---|\n" + "".join(rows) + "\n" + found[3]

    return TABLE.sub(table, text)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, schema in schemas():
        (FOLDER / name).write_bytes(schema)
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
