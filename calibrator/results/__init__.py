"""Result of a calibration: a folder with ``run.json``, ``results.parquet`` and the parameter files."""
