"""Arbiters decide in which episodes the guide acts: guided or paced episodes, labels as prior, comparison by value."""
