"""Which samples the update learns from: one file per rule."""
