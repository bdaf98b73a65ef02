"""What is in logs, found without a configuration; and a configuration to start from."""
