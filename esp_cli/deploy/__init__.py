"""Trained policies in other hands: the box that comes along, loading by name, export."""
