"""What to run and how: the paper's studies as lists of runs, the scheduler, the engine that starts processes."""
