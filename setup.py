"""Builds the compiled kernel in its two widths; all else is in pyproject.toml. Without a compiler it is left out."""

from pathlib import Path

from Cython.Build import cythonize
from setuptools import Extension, setup

KERNEL = Path("fusiond/filter/kernel")

# No fused multiply-add: the results are to be the same bits on every processor.
WIDTHS = [
    Extension(
        f"fusiond.filter.kernel.{name}",
        [str(KERNEL / f"{name}.pyx")],
        depends=[str(part) for part in sorted(KERNEL.glob("*.pxi"))],
        extra_compile_args=["-O3", "-ffp-contract=off"],
    )
    for name in ("narrow", "wide")
]

modules = cythonize(WIDTHS)
for module in modules:
    module.optional = True  # a failed build leaves the kernel to the interpreter (cythonize drops the original's flag)

setup(ext_modules=modules)
