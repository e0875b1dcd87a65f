"""Alarms as ISA-18.2 has them: rules, states, episodes. Pure logic: no clock, no database."""
