"""Worker processes, and the signals that end them and the program itself."""
