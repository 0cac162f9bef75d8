"""A Dask cluster for tests."""
