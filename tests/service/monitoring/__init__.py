"""How the service is watched, and how it ends."""
