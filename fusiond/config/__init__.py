"""The configuration: its tables, how they are read and checked, what they mean in words, what a reload may change."""
