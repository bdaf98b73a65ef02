"""The host: its clock, its journal, its service manager."""
