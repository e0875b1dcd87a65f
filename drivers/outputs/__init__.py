"""What the twin gives to others: values written to a PLC, results served over OPC UA."""
