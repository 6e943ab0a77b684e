"""The science: pure functions on pytrees, for one member. Begin with `types.py`."""
