"""Updates of parameters: from a repository of The Update Framework (TUF) to parameters in force, see docs/trust.md."""
