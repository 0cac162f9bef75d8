"""The service over TLS as its users reach it."""
