"""Alarms as ISA-18.2 has them: rules, states, episodes; beside the loop, and in a database."""
