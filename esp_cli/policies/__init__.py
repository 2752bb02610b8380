"""Trained policies: load them, play them, and say how good they are."""
