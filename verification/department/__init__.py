"""Two real rooms and a hub that follows them, in networks of their own: what is away, and what arrives afterwards."""
