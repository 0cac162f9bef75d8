"""Beam line status published to subscribers that only display it."""
