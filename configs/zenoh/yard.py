"""Writes the configuration of a Zenoh router for a yard of vehicles: configs/zenoh/yard.json5, for your vehicles' names.

    python yard.py --slow wlan0 van01 van02 van03 > yard.json5
    zenohd --config yard.json5

Each vehicle has a certificate whose common name is its name, and may publish under its own keys only; readers have one
whose common name is reader, and may read all. Over the interfaces that are named slow, readers get one state a second.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import Any

PUBLISHED = ["put", "delete", "reply", "declare_queryable", "liveliness_token"]
ASKED = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]
ALL = ["fusiond/**", "fusiond/*/@alive/**", "fusiond/**/@adv/**"]  # @ chunks are not in **
SLOW_HZ = {"state": 1.0, "settled": 0.1, "innovations/**": 0.1}  # each key's samples a second
HEAD = """\
// A Zenoh router for a yard: mTLS, each vehicle under its own name only, readers over slow links thinned, and the history
// of health and events kept. Made by `python yard.py NAME...`, which says what the certificates must be; see docs/fleet.md.
"""


def rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    """A rule of access control that allows messages."""
    return {"id": name, "flows": [flow], "permission": "allow", "messages": messages, "key_exprs": keys}


def access(vehicles: Sequence[str]) -> dict[str, Any]:
    """Who may do what, by the common name of the certificate."""
    own = [
        rule(f"{name} publishes", "ingress", PUBLISHED, [key.replace("fusiond/", f"fusiond/{name}/", 1) for key in
             ("fusiond/**", "fusiond/@alive/**", "fusiond/**/@adv/**")])
        for name in vehicles
    ]  # fmt: skip
    shared = [
        rule("vehicles are queried", "egress", ASKED, ALL),
        rule("readers query", "ingress", ASKED, ALL),
        rule("readers receive", "egress", PUBLISHED, ALL),
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": own + shared,
        "subjects": [
            *({"id": name, "cert_common_names": [name]} for name in vehicles),
            {"id": "readers", "cert_common_names": ["reader"]},
        ],
        "policies": [
            *({"subjects": [name], "rules": [f"{name} publishes", "vehicles are queried"]} for name in vehicles),
            {"subjects": ["readers"], "rules": ["readers query", "readers receive"]},
        ],
    }


def configuration(vehicles: Sequence[str], slow: Sequence[str]) -> dict[str, Any]:
    """The whole file."""
    made: dict[str, Any] = {
        "mode": "router",
        "listen": {"endpoints": ["tls/0.0.0.0:7447"]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "unicast": {"max_sessions": 10_000},
            "link": {
                "tls": {
                    "root_ca_certificate": "/etc/fusiond/zenoh/ca.pem",
                    "listen_certificate": "/etc/fusiond/zenoh/router.pem",
                    "listen_private_key": "/etc/fusiond/zenoh/router.key",
                    "enable_mtls": True,
                }
            },
        },
        "access_control": access(vehicles),
    }
    if slow:
        rules = [{"key_expr": f"fusiond/*/{key}", "freq": freq} for key, freq in SLOW_HZ.items()]
        thinned = {"id": "slow readers", "interfaces": list(slow), "messages": ["put"], "flows": ["egress"], "rules": rules}
        made["downsampling"] = [thinned]
    history = {kind: {"key_expr": f"fusiond/*/{kind}", "volume": "memory"} for kind in ("health", "events")}
    made["plugins"] = {"storage_manager": {"storages": history}}  # zenohd's own; a router without it goes on without history
    return made


def main() -> None:
    """Print the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("vehicles", metavar="NAME", nargs="+", help="names of the vehicles, as in [vehicle]")
    parser.add_argument("--slow", metavar="INTERFACE", action="append", default=[], help="where readers are thinned")
    options = parser.parse_args()
    print(HEAD + json.dumps(configuration(options.vehicles, options.slow), indent=2))


if __name__ == "__main__":
    main()
