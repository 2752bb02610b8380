"""Bundled policies, loading a policy by name, export to other programs and robots."""
