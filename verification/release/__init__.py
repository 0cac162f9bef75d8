"""A release: checked, built, listed, and its data folder kept for the upgrade tests of later ones; `make release`."""
