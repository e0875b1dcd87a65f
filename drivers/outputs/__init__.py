"""Outputs of the twin: values written to a PLC, results served over OPC UA."""
