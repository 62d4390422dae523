"""Pages that show a result: one of the whole fleet, and one of each vehicle. HTML files that need nothing else."""
