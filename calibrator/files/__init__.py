"""Files that are read and written: whole or not at all, here or at a URL."""
