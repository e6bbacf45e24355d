"""Parallel stepping of environments: each worker process steps a part (shard) of them.

All results are bit-identical to those of a single process.
"""
