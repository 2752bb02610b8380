"""Files: written whole or not at all, opened without following planted links, JSON documents of a known format."""
