"""What the tests share: the kernel under test, compiled and interpreted."""

from __future__ import annotations

import signal

import pytest

from fusiond.filter.kernel.interpreted import compiled_available

needs_compiled = pytest.mark.skipif(not compiled_available(), reason="the compiled kernel was not built")


@pytest.fixture(params=[pytest.param(True, id="compiled", marks=needs_compiled), pytest.param(False, id="interpreted")])
def compiled(request: pytest.FixtureRequest) -> bool:
    """Which kernel to ask for."""
    return bool(request.param)


def pytest_configure() -> None:
    """What is started in the background ignores SIGINT, and hands that on to all that it starts: not so the tests."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
