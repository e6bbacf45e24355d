"""Terms of manager-based tasks. Each section of the YAML has one module of functions and classes.

The shape of the result is at the end of a term's summary, or below the summary. Joint quantities are in m (slide)
or rad (hinge), efforts in N or N m. Names and meanings follow Isaac Lab's `mdp` module; `Isaac Lab: NAME` in a
docstring is the name there, and `Isaac Lab: TEXT` a difference.
"""
