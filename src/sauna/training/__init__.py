"""A run: prepared, trained by worker processes, written to disk."""
