"""Recordings of real vehicles, CAN logs and CSV files: reading them into drives, and writing logs."""
