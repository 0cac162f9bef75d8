"""Readiness, certificate expiry and metrics."""
