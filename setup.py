"""Builds the compiled kernel in its two widths; all else is in pyproject.toml. Without a compiler it is left out."""

from pathlib import Path

from Cython.Build import cythonize
from setuptools import Extension, setup

# No fused multiply-add: the results are to be the same bits on every processor.
KERNELS = [
    Extension(
        f"fusiond.{name}",
        [f"fusiond/{name}.pyx"],
        depends=["fusiond/_kernel.pxi", *map(str, sorted(Path("fusiond/compiled").glob("*.pxi")))],
        extra_compile_args=["-O3", "-ffp-contract=off"],
    )
    for name in ("_kernel", "_kernel_wide")
]

modules = cythonize(KERNELS)
for module in modules:
    module.optional = True  # a failed build leaves the NumPy twin (cythonize drops the flag of the original)

setup(ext_modules=modules)
