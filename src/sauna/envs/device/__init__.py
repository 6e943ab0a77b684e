"""Environments as pure functions, stepped inside the compiled program."""
