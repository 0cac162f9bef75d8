"""Authentication and authorisation: accounts, log-ins, API keys, and the rules that each request is checked against.

Requests are authenticated from memory (`accounts.store` writes through to the database), so that a hold never waits for
the disk.
"""
