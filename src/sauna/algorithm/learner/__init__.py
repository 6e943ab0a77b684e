"""Learning from a rollout: advantages, objectives, the update."""
