"""Every promise of the product, measured again on one commit: steps that measure, and rows that judge."""
