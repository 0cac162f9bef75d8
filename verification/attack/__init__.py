"""Attacks on the way in: raw bytes against a real server, beside a session whose frames go on."""
