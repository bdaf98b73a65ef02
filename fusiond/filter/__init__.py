"""The filter: one event into the state, as pure functions of state, event and parameters."""
