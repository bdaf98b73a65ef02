"""`fusiond mount`: the mounting angles of the inertial sensor, estimated from a drive."""
