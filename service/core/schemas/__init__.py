"""Pydantic schemas of the HTTP contract."""
