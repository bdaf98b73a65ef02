"""Replay of recorded drives, and what is reported of them."""
