"""Read recordings of real vehicles (CAN logs, tables) into drives, and write logs."""
