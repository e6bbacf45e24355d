"""Environments in shards: each worker process steps a part of them, and the results are bit-identical."""
