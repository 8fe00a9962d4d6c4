"""What became of a training, on one page."""
