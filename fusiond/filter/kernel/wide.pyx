# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The compiled hot loop (kernel.pxi) for the state with all calibrations: see there."""

cdef enum:
    n = 27  # error states

include "kernel.pxi"
