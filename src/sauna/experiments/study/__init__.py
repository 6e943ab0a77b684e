"""Studies: arms compared over tasks and seeds, and what the comparison supports."""
