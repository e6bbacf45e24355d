"""Physics engines that step many worlds of one model, one per environment.

A `Selection` is some of these worlds, such as those to reset.
"""
