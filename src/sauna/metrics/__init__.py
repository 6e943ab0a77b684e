"""Metrics: `metrics.jsonl` is the truth, everything else shows it."""
