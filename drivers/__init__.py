"""Where samples come from: drivers for real PLCs, and the simulated PLC."""
