"""The loop over many events, compiled for two sizes of the state."""
