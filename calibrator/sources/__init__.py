"""The drives of a fleet, wherever they are: which log belongs to which vehicle, what was recorded twice."""
