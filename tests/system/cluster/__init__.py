"""Recordings measured by a Dask cluster of real processes over TLS."""
