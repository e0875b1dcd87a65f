"""The physics: pure functions and tables, no files, no clocks, no network."""
