"""Terms of manager-based tasks. Each section of the YAML has one module of functions and classes.

Each docstring ends its summary with the shape of the result. Joint quantities are in m (slide) or rad (hinge), efforts
in N or N m. Names and meanings follow Isaac Lab's `mdp` module.
"""
