"""A grid world on a torus, seen in pictures."""
