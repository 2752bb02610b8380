"""Training: the collect-update-evaluate loop, run folders, checkpoints and metrics."""
