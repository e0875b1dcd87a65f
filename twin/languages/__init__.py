"""Languages of texts for people. A new one is a catalogue: ``python tools/texts.py fr``."""
