"""A trained policy: read from a run, and played."""

from sauna.algorithm.rollout import MAX_STEPS as MAX_STEPS
