"""The system tests under pytest: `pytest -m system`. `make test-system` shows their table."""

from __future__ import annotations

import pytest

from tests.system import guest
from tests.system.__main__ import run


@pytest.mark.system
def test_the_installed_service_survives_its_faults() -> None:
    try:
        status = run(here=False)
    except guest.Unavailable as reason:
        pytest.skip(str(reason))
    assert status == 0, "see out/system"
