"""Random covariances."""

from __future__ import annotations

import numpy as np


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.standard_normal((n, n))
    return root @ root.T + 0.1 * np.eye(n)
