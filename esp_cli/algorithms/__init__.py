"""Learners. Each is one file: its config and its linear `update`."""
