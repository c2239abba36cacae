"""Fetch of gymnasium_robotics: scripted policies."""
