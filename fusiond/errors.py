"""Errors that the user can fix: they end a command with one line on stderr, and each kind has an exit code."""

from __future__ import annotations


class UsageError(Exception):
    """A wrong command line or configuration; the message says why."""


class UnusableError(Exception):
    """An input that cannot be used, or an output that cannot be written; the message says which and why."""

    code = 1  # the exit code of a command that it ends


class OutputError(UnusableError):
    """A result cannot be delivered; the message says where and why."""
