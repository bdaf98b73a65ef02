"""Replay of recorded drives, and its reports."""
