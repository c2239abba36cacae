"""Fetch of gymnasium_robotics: scripted policies, and a camera that stands elsewhere than the arm believes."""
