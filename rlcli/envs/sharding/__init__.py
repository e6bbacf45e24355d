"""Environments in shards: each worker process steps a part of them; results are bit-identical to one process."""
