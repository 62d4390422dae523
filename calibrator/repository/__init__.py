"""The repository from which vehicles take their parameters (The Update Framework, TUF), see docs/trust.md."""
