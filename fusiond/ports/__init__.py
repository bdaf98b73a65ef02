"""The interfaces that adapters implement: inputs, outputs, and the bounded queues between their threads and the engine."""
