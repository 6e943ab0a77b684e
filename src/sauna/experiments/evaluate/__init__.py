"""A trained policy: read from a run, and played."""
