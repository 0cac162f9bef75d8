"""State kept from frame to frame: region, costal line, depth table, surface continuity, breathing."""
