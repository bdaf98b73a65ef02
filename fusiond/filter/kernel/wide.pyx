# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Made by tools/translate_kernel: not to be edited.
"""The compiled hot loop (kernel.pxi) for the state with all calibrations: see there."""

cdef enum:
    n = 37  # error states

include "kernel.pxi"
