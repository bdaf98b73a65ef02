"""A finding: what the data of a drive say against its configuration, with the number behind it and the key to change."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from fusiond.config.toml import line_of, read_text
from fusiond.errors import UnusableError

NO_STATE, CONTRADICTED = 3, 4  # exit codes
Weight = Literal["no_state", "contradiction", "note"]


class NothingAskedFor(UnusableError):
    """Logs without anything that the configuration asks for; the message says why."""

    code = NO_STATE


class Finding(Struct, frozen=True, kw_only=True):
    """One finding. `no_state`: it is why there is no state; `contradiction`: the data contradict the configuration; `note`:
    the result may be right, and deserves a look."""

    kind: str  # such as wheel_unit; docs/doctor.md lists them
    weight: Weight = "contradiction"
    text: str  # a sentence, with the number behind it
    key: str = ""  # dotted key of the configuration to change; empty: none would help
    place: str = ""  # where that key is, as file:line
    value: str = ""  # to try for the key, as it is written in the configuration; empty: not known


def located(findings: Iterable[Finding], file: Path) -> list[Finding]:
    """The same findings with the line of each key; of a key that is not given, that of its table."""
    findings = list(findings)
    text = read_text(file) if findings else ""
    return [replace(one, place=f"{file.name}:{line_of(one.key, text)}") if one.key else one for one in findings]


def exit_code(findings: Iterable[Finding]) -> int:
    """What a command ends with after these findings: 0 where all is well, or only notes are left."""
    weights = {one.weight for one in findings}
    return NO_STATE if "no_state" in weights else CONTRADICTED if "contradiction" in weights else 0


def lines(findings: Iterable[Finding]) -> Iterator[str]:
    """The findings as text: the sentence, then where to change what."""
    for one in findings:
        yield f"{'note' if one.weight == 'note' else 'found'}: {one.text}"
        if one.key:
            try_it = f" = {one.value}" if one.value else ""
            yield f"       {one.place + ': ' if one.place else ''}{one.key}{try_it}"
