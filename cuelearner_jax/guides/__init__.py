"""Guides: fit a model to a teacher's answers and refine actions by the model; one file for each kind."""
