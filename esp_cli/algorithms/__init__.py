"""Learners. Each is one file: its config, its linear `update`, and the presets that were measured for it."""
