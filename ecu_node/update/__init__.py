"""Updates of parameters, from a repository of The Update Framework (TUF) until they are in force; see docs/trust.md."""
