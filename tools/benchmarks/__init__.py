"""What ``tools/bench.py`` measures, and the floors it measures beside it."""
