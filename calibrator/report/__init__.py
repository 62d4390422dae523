"""The page that shows a result: one HTML file of the whole fleet, or of one vehicle, that needs nothing else."""
