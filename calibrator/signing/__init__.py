"""Signing parameter files: keys of the signers, key sets for the vehicles, signed statements."""
