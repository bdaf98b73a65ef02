"""For programs that read fusiond: see `fusiond.app.client`, whose public names are these."""

from __future__ import annotations

from fusiond.app.client import DEFAULT_ENDPOINT, Client, ClientError

__all__ = ["DEFAULT_ENDPOINT", "Client", "ClientError"]
