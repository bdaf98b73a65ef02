"""The live daemon."""
