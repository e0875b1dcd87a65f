"""Fleets: thousands of logs, each analysed once; results are stored and units compared."""
