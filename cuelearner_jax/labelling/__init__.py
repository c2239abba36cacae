"""Collect labels from people: the labelling session, and the browser page that shows its questions."""
