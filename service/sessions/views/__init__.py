"""Engine results as the HTTP contract shows them."""
