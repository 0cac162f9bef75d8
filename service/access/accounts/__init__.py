"""Accounts: users, their roles and passwords, and the store of all access records."""
