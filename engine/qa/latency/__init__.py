"""The camera's latency, from light to received frame, measured with a light or a plate of known times."""
