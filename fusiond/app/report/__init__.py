"""The report of a replay: one HTML file with the track, plots linked in time, tables and findings, that needs no network."""
