"""Who may do what: people, their log-ins, API keys, and the guard that every request passes.

Answered from memory (`store` writes through to the database): who holds a beam does not wait for a disk.
"""
