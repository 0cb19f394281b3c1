"""Composition root: sources, session runner, logs, viewer, reports, command line."""
