"""Key figures of each cycle, as maintenance knows them: measured, expected, stored, trended."""
