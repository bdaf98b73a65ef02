"""The installed service on a real systemd and real vcan: here, or in a guest. Run by `make test-system`."""
