"""The options of a cluster."""
