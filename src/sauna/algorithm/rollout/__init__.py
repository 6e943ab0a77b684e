"""Collecting a rollout, on the host or on the device."""
