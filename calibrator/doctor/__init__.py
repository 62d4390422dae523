"""What of a user's layout and logs can be used, and what is wrong with it."""
