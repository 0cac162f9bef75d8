"""Samples, one file per session: an Arrow stream while it runs, Parquet once it is closed.

See docs/3-operate/samples.md.
"""
