"""Runs of SLAM: demo, real modules, replay."""
