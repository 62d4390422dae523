"""Worker processes, and the signals that end them and this one."""
