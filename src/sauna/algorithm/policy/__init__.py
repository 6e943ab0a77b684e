"""The policy: networks, action distributions, normalisation."""
