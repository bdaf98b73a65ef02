"""Mathematics that knows nothing of vehicles or filters: portable functions, rotations, the ellipsoid, statistics."""
