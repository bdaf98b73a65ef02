"""The client for programs that read fusiond; `fusiond.app.client` has the implementation."""

from __future__ import annotations

from fusiond.app.client import DEFAULT_ENDPOINT, Client, ClientError

__all__ = ["DEFAULT_ENDPOINT", "Client", "ClientError"]
