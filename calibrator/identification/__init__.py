"""State-space models of vehicles from their drives."""
