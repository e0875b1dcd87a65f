"""The model and its data in the formats of other tools."""
