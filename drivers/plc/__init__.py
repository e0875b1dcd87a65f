"""A simulated PLC with an ejector behind it; shares no code with twin.model (see rig.py)."""
