"""Notifications: an outbox that outlives the program, and the senders that deliver from it."""
