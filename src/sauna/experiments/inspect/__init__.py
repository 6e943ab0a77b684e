"""What a trained policy meets in an episode, step by step, and what the filter makes of it."""
