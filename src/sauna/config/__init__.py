"""Every choice of a run: its fields, presets and arms, and how they are read."""
