"""What ends a command with one line on stderr: the kinds of error that its user can mend, by exit code."""

from __future__ import annotations


class UsageError(Exception):
    """A command line or a configuration that cannot be; the message says why."""


class UnusableError(Exception):
    """An input that cannot be used, or an output that cannot be written; the message says which and why."""


class OutputError(UnusableError):
    """A result cannot be delivered; the message says where and why."""
