"""A department: rooms with PostgreSQL, and the hub that follows them."""
