"""What is asked of trained members: evaluation, studies, measurements, reports."""
