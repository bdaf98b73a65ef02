"""Changes of keys in a configuration's text: comments, order and all other lines stay."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping


def with_keys(text: str, changes: Mapping[tuple[str, str], float | list[float]]) -> str:
    """The text with keys set: of each (table, key) the value, such as ("gnss.gps0", "delay_ms"). A key that is not there is
    put behind its table's header; a table that is not there, at the end."""
    lines = text.splitlines()
    for (table, key), value in changes.items():
        begin, end = _table(lines, table)
        if begin is None:
            lines += ["", f"[{table}]", f"{key} = {value!r}"]
            continue
        pattern = re.compile(rf"^(\s*{re.escape(key)}\s*=\s*)([^#]*?)(\s*(#.*)?)$")
        places = [i for i in range(begin + 1, end) if pattern.match(lines[i])]
        if places:
            found = pattern.match(lines[places[0]])
            assert found
            lines[places[0]] = f"{found[1]}{value!r}{found[3]}"
        else:
            lines.insert(begin + 1, f"{key} = {value!r}")
    changed = "\n".join(lines) + "\n"
    tomllib.loads(changed)
    return changed


def _table(lines: list[str], table: str) -> tuple[int | None, int]:
    """The line of a table's header, and the line after its last."""
    begin = None
    for i, line in enumerate(lines):
        header = re.match(r"^\s*\[\s*([^\]]+?)\s*\]", line)
        if not header or line.lstrip().startswith("[["):
            continue
        if begin is not None:
            return begin, i
        if [part.strip().strip('"') for part in header[1].split(".")] == table.split("."):
            begin = i
    return begin, len(lines)
