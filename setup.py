"""Builds the compiled kernel; everything else of the package is in pyproject.toml. Without a compiler it is left out."""

from Cython.Build import cythonize
from setuptools import Extension, setup

setup(
    ext_modules=cythonize(
        [
            Extension(
                "fusiond._kernel",
                ["fusiond/_kernel.pyx"],
                extra_compile_args=["-O3", "-ffp-contract=off"],
                optional=True,  # a failed build leaves the NumPy twin
            )
        ]
    )
)
