"""Key figures per cycle, as a maintenance person knows them: measured, expected, kept, trended."""
