"""Alembic migrations, a package so that an installed Tidegate finds them."""
