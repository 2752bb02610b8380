"""Symmetry inside training loops of others: plain PyTorch, TorchRL, BenchMARL."""
