"""OPC UA: settings, subscriptions and the trace ring, certificates and bounds."""
