"""The estimator: every event of the horizon in order, the filter over them, and the solution that comes out."""
