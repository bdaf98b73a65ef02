"""The host: its clock, its journal, its service manager, and folders of bounded size."""
