"""Site rules: what a session may measure, play and gate on."""
