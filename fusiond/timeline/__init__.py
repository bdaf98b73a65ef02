"""One time line for all clocks: alignment of stamps, least offsets, round trips."""
