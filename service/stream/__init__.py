"""The live stream: one hub makes every message once, and hands it to however many watch."""
