"""Environments that are stepped on the host: Gymnasium, MuJoCo, Atari."""
