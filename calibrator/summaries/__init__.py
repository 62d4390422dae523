"""Summaries of a fleet's drives, which hold all that the estimator needs, on disk or in object storage."""
