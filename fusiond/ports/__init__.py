"""What an adapter implements: inputs, outputs, and the bounded boxes between their threads and the engine."""
