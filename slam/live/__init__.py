"""Scans of modules and of recorded sessions, with their times."""
