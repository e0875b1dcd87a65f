"""A simulated PLC with an ejector behind it; shares no physics with twin.model."""
