"""Languages of texts for people. The translations are in ``twin/locale``, such as ``de.po``.

A new language is a catalogue: ``python tools/texts.py fr``.
"""
