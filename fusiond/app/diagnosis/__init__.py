"""The diagnosis of a drive: what its data say of the configuration, as findings."""
