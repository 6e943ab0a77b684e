"""Collecting a rollout, on the host or on the device."""

MAX_STEPS = 30_000  # env steps after which a played episode is cut; Atari's time limit is 27,000
