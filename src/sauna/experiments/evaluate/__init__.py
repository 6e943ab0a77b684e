"""A trained policy: read from a run, and played."""

MAX_STEPS = 30_000  # env steps after which an episode is cut; Atari's time limit is 27,000
