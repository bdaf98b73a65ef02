"""Prints the manual page fusiond(1), in roff, from the grammar of the command line."""

from __future__ import annotations

import argparse

from fusiond import __version__
from fusiond.__main__ import parser
from fusiond.app.commands import COMMANDS


def page() -> str:
    """The whole page."""
    top = parser()
    lines = [
        f'.TH FUSIOND 1 "" "fusiond {__version__}" "User Commands"',
        *section("NAME", r"fusiond \- vehicle telemetry fusion"),
        *section("SYNOPSIS", ".B fusiond\n.I COMMAND\n.RI [ OPTIONS ]\n.br\n.B fusiond \\-\\-version"),
        *section("DESCRIPTION", escaped(top.description or "")),
        ".SH COMMANDS",
    ]
    for name in COMMANDS:
        lines += command(name)
    lines += section("EXIT STATUS", escaped(top.epilog or ""))
    lines += [".SH FILES", *entry("/etc/fusiond/fusiond.toml", "configuration of the service")]
    lines += entry("/usr/share/fusiond/examples", "configurations to begin with")
    lines += entry("/var/lib/fusiond", "what the service may write to: its black box and its stored state")
    lines += section("SEE ALSO", ".BR systemctl (1),\n.BR journalctl (1)")
    return "\n".join(lines) + "\n"


def command(name: str) -> list[str]:
    """A command: what it does, and its options."""
    choices = next(action for action in parser(name)._actions if isinstance(action, argparse._SubParsersAction)).choices
    one = choices[name]
    lines = [f".SS fusiond {name}", escaped(one.description or "")]
    for action in one._actions:
        if not isinstance(action, argparse._HelpAction):
            names = ", ".join(action.option_strings) or str(action.metavar or action.dest)
            value = f" {action.metavar or action.dest.upper()}" if action.option_strings and action.nargs != 0 else ""
            about = (action.help or "").replace("%(default)s", str(action.default)).replace("%%", "%")
            lines += entry(names + value, about)
    return lines


def section(title: str, text: str) -> list[str]:
    return [f".SH {title}", text]


def entry(name: str, text: str) -> list[str]:
    """A term and what it means."""
    return [".TP", f".B {escaped(name)}", escaped(text)]


def escaped(text: str) -> str:
    """Plain text as roff: no line of it is a request."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return "\n".join("\\&" + line if line[:1] in (".", "'") else line for line in text.splitlines() if line.strip())


if __name__ == "__main__":
    print(page(), end="")
