"""A session's life: lifecycle, recovery, records and views."""
