"""The system tests under pytest: `pytest -m system`. `make test-system` shows their table."""

from __future__ import annotations

import pytest

from tests.system import guest
from tests.system.__main__ import judge


@pytest.mark.system
def test_the_installed_service_survives_its_faults() -> None:
    try:
        failed = judge(here=False, twice=False)
    except guest.Unavailable as reason:
        pytest.skip(str(reason))
    assert not failed, "see out/system"
