"""Safeguards of the compact ejector's own control: valve protection, and judging leakage."""

PROTECTED_SWITCHES = 6  # more switchings than this within PROTECTED_S mean continuous suction
PROTECTED_S = 3.0  # s
LEAK_SETTLE_S = 0.05  # s from the nozzle's going off until leakage is judged
