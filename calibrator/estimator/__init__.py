"""The default method: from drive summaries of a fleet to the faults of its sensors."""
