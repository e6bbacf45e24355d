"""Reports about runs and tasks: learning curves, heat maps, task cards, and the HTML page of a run.

The commands `plot`, `report`, `stress` and `sweep` use them.
"""
