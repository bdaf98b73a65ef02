"""Observation models, one file each; the table in this module lists them all."""
