"""Authentication and authorisation of one request: address, identity, rule, claimed operator."""
