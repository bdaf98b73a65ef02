"""Builds the compiled kernel; everything else of the package is in pyproject.toml. Without a compiler it is left out."""

from Cython.Build import cythonize
from setuptools import Extension, setup

# No fused multiply-add: the results are to be the same bits on every processor.
KERNEL = Extension("fusiond._kernel", ["fusiond/_kernel.pyx"], extra_compile_args=["-O3", "-ffp-contract=off"])

modules = cythonize([KERNEL])
for module in modules:
    module.optional = True  # a failed build leaves the NumPy twin (cythonize drops the flag of the original)

setup(ext_modules=modules)
