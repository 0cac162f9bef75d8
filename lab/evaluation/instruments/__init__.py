"""Comparison with other instruments: laser line and spirometer."""
