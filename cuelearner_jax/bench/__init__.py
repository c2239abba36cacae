"""Measuring a machine, and the machines that are known."""
