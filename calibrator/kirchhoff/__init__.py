"""The sum of a junction's currents, before and after a correction: figures, table and picture."""
