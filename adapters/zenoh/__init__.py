"""Zenoh: sessions, the publishing output, answers to queries."""
