"""Physics engines, on the CPU (`batch`) and on the GPU (`warp`), and functions for their states.

An engine steps many worlds of one model; a world is the simulation of one environment. A `Selection` is a subset of the
worlds, such as those to reset, and draws random numbers for them.
"""
