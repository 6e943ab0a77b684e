"""Training a study's units: here or on a Ray cluster."""
