"""Files, processes and signals: what a run needs of the operating system."""
