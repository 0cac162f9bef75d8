"""What was measured, one file a session: an Arrow stream while it runs, Parquet once it is closed (docs/samples.md)."""
