"""Two tracks of one drive, compared."""
