"""A department that follows rooms: docker/department's own files on two real PostgreSQL servers."""
