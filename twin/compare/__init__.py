"""Comparison of two logs: what differs, by how much, and how certain that is."""
