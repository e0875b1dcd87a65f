"""Thousands of logs: each judged once, what was found kept, and all compared."""
