"""Makes the compiled kernel out of the filter: see __main__.py."""
