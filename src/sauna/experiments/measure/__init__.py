"""Measurements of trained members at their checkpoints; see `measure/__main__.py`."""
