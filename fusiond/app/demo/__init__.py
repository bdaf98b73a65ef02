"""The demonstration and its bundled drive."""
