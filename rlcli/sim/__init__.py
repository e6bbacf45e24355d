"""Physics engines. An engine steps many worlds (simulations) of one model, one for each environment.

A `Selection` is a part of the worlds, such as those to reset, with random numbers for them.
"""
