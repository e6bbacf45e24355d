"""Recorded episodes, failure cases and crash dumps: one file format and one replayer."""
