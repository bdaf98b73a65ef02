"""Where things lie, for tests in whatever folder."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
CAPTURED = ROOT.parent / "shared" / "data"  # real traces, beside the project; tests that use them skip without
