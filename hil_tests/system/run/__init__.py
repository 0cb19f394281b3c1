"""Whole runs: demo and run."""
