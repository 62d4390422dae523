"""Make and store summaries of drives, which hold all that the estimator needs, on disk or in object storage."""
