"""Logs on disk: MCAP in and out."""
