"""Where things lie, for tests in whatever folder."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOTS = {"fusiond": ROOT / "fusiond", "fusiond_adapters": ROOT / "adapters"}  # folder of each import package
CAPTURED = ROOT.parent / "shared" / "data"  # real traces, beside the project; tests that use them skip without
