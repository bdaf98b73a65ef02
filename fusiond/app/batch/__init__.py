"""Many drives: each is replayed in a process with limits of its own, and gives one row."""
