"""Modbus TCP: settings, requests, polling and the trace ring."""
