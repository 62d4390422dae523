"""Sensors that are not linear: gain that differs by the sign of the current, or drifts with temperature."""
