"""Reports about runs and tasks: learning curves, heat maps, tables that describe a task, and the HTML page of a run.

The commands `plot`, `report`, `stress` and `sweep` use these modules.
"""
