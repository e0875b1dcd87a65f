"""What the measured and the expected pressure say while the loop runs."""
