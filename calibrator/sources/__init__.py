"""Find and load the drives of a fleet on disk or in object storage: which log belongs to which vehicle."""
