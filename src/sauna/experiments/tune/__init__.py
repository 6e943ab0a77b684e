"""Searching for settings: trials by Optuna, or a population that is trained and changed."""
