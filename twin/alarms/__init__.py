"""Alarms after ISA-18.2: rules, states and episodes, in the live loop and in a database."""
