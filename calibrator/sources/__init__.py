"""Find the drives of a fleet, wherever they are, and which log belongs to which vehicle; import logs as drives."""
