"""Recorded logs: a reader for each format, the merge of several, the black box, and drives written and played."""
