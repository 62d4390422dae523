"""Read and write files and folders, whole or not at all, on this machine or at a URL."""
