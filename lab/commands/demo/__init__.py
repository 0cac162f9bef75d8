"""The demonstration: a volunteer measured by a service that is started for it."""
