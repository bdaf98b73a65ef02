"""Zenoh's endpoints as users write them, and its errors as users can read them."""

from __future__ import annotations

import re

PORT = 7447  # of fusiond, and of Zenoh's routers

SOURCE = re.compile(r" at \S+\.rs:\d+\.?")  # a place in Zenoh's own source
SYSTEM_ERROR = re.compile(r" \(os error \d+\)")
NOT_REACHED = re.compile(r"Unable to connect to any of \[.*\]!?", re.DOTALL)
NOT_BOUND = re.compile(r"Can ?not create a new \w+ listener (?:bound to|on) [^\s\[\]]+?(?::\s+\[[^\[\]]*?|\. |: )(?=[A-Z])")
NOTHING_GIVEN = re.compile(r"No peer specified and multicast scouting deac?tivated!?")
MESSAGE = re.compile(r"Message \{ msg: \"(?P<text>(?:[^\"\\]|\\.)*)\"(?P<rest>.*)\}", re.DOTALL)
LOCATION = re.compile(r"line: (\d+), column: (\d+)")
EXCERPT = re.compile(r"\s*--> (\d+):(\d+)\n.*= (.*)", re.DOTALL)  # a place in a file, with the line drawn below it


def endpoint(text: str) -> str:
    """HOST or HOST:PORT as an endpoint of Zenoh by TCP; what names its protocol stays as it is."""
    if "/" in text:
        return text
    bare_ipv6 = text.count(":") > 1 and not text.startswith("[")
    host = f"[{text}]" if bare_ipv6 else text
    with_port = re.search(r":\d+$", host) and not bare_ipv6
    return f"tcp/{host}" if with_port else f"tcp/{host}:{PORT}"


def in_words(error: Exception) -> str:
    """The reason of one of Zenoh's errors: without places in its source, and without Rust's notation."""
    text = SOURCE.sub("", str(error)).strip()
    if found := MESSAGE.search(text):
        words = found["text"].replace('\\"', '"')
        at = LOCATION.search(found["rest"])
        return f"line {at[1]}, column {at[2]}: {words}" if at else words
    if found := EXCERPT.match(text):
        return f"line {found[1]}, column {found[2]}: {found[3].strip()}"
    text = NOT_REACHED.sub(_not_reached, text)
    text = NOTHING_GIVEN.sub("nothing to connect to is given, and multicast scouting is off", text)
    text = SYSTEM_ERROR.sub("", NOT_BOUND.sub("", text))
    return text.rstrip("!. ]")


def _not_reached(found: re.Match[str]) -> str:
    by_certificate = re.search(r"\b(tls|quic)/", found[0])
    return "no Zenoh answers there" + (", or one side refuses the other's certificate" if by_certificate else "")
