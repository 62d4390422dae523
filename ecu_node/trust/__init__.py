"""Parameters that can be trusted: who signed them, for which vehicle, for when, and in which order."""
