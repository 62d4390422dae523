"""The method of [1]_, as published: fleet mean, classifier, regression and quadratic basis pursuit.

What the paper leaves open, and what was chosen, stands in ``docs/published_method.md``.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""
