"""How commands meet their user: the command line, its options, progress, notices, tables and text."""
