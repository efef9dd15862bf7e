"""Error against run time: problems with known flows, work-precision diagrams, stability."""
