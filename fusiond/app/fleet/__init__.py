"""Many running vehicles at once: what each does, and alarms."""
