"""The application: everything that opens files, sockets and terminals, and the only importer of adapters."""
