"""Beam lines: what transmits the permit to the accelerator, behind one protocol."""
