"""Log-ins, API keys, login cookies, lockout after failures, and the record of refusals."""
