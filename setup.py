"""Builds the compiled kernel in two widths, if there is a compiler, and gives the package its README. Everything else is in
pyproject.toml."""

import runpy
from pathlib import Path

from Cython.Build import cythonize
from setuptools import Extension, setup

KERNEL = Path("fusiond/filter/kernel")

# No fused multiply-add, so that the results have the same bits on every processor.
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
    module.optional = True  # without a build the NumPy kernel serves (cythonize drops the flag of the original)

readme = runpy.run_path("packaging/readme.py")["long_description"]()
setup(ext_modules=modules, long_description=readme, long_description_content_type="text/markdown")
