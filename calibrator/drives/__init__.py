"""Store drives, align their channels on one time base, and find the delays between branches."""
