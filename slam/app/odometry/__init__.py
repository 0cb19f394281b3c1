"""Wheel odometry and trajectories as TUM text."""
