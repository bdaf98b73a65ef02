"""CAN: buses and drivers, DBC decoding, checksums."""
