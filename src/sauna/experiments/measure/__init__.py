"""Measurements of trained members at their checkpoints: each is one `Measurement`."""

from sauna.experiments.measure.measurement import Measurement

__all__ = ["Measurement"]
