"""Fuzzers: seeded damage to everything that fusiond reads, until a time is over. `make fuzz` runs them; pytest does not."""
