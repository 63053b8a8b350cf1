"""Studies: the plan of a sweep, its run directory, tables, statistics, figures and page."""
