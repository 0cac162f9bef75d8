"""Problem details (RFC 9457): the table of errors and the catalogue."""
