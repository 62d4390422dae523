"""Summaries of a fleet's drives on disk or in object storage: all that the estimator needs of them."""
