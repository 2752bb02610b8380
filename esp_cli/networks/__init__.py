"""Seed-batched networks: S independent networks of one shape, held and trained as one."""
