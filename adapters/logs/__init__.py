"""Readers of recorded logs, one file per format, and the merge of several logs into one stream."""
