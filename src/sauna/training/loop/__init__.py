"""The training loop of one process: collect -> advantages -> update -> log -> save."""
