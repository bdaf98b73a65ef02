"""What a log can tell of its own noise, delays and installation, and a better configuration."""
