"""Many networks under one budget: the paper's task-performance figure, trained beside random."""
