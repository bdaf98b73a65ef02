"""A seeded vehicle simulator: trajectory, sensors and their faults, in the true wire formats."""
