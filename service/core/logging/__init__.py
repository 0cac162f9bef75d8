"""Log records: not blocking, without patient data, with request ids."""
