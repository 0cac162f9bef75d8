"""Prometheus metrics of engine, HTTP and machine."""
