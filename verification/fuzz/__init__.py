"""Fuzzing of everything that reads what unknown callers wrote: targets, corpus, driver, record.

Each target is a reader and the errors it may raise; anything else that comes out of it is a finding. `make fuzz` runs
them under atheris, `python -m verification.fuzz --replay FILE` reads one input again, and `make verify` replays the
corpus.
"""
