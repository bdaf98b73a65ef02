"""Protocols, files and networks at the edge of fusiond; installed as the import package `fusiond_adapters`."""
