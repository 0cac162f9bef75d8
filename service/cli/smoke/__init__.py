"""``tidegate smoke``: is the service at an address up, ready, trusted and alive; asked from outside, over HTTP only."""
