"""From healthy cycles of one unit to its instance-specific data set."""
