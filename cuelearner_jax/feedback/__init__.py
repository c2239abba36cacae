"""Feedback: forms of answers, a simulated teacher, and checks of given labels."""
