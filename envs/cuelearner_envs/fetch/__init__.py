"""Fetch of gymnasium_robotics: scripted policies, and a camera displaced from where the arm believes."""
