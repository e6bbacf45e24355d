"""Physics engines, on the CPU (`batch`) and on the GPU (`warp`), and helpers for their states.

An engine steps many worlds (simulations) of one model, one world for each environment. A `Selection` is a subset of the
worlds, such as those to reset, and draws random numbers for them.
"""
