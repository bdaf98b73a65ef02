"""Recorded logs: readers for each format, merging, the black box, writing and playing drives."""
