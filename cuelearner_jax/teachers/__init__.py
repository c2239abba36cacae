"""Learned teachers and their training."""
