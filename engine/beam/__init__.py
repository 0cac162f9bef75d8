"""The lines that carry the permit to the accelerator, behind one protocol."""
