"""Recordings on a Dask cluster (`--scheduler`): one job a recording, run by workers on other machines."""
