"""The application as a library: what the commands do, as functions for other programs."""
