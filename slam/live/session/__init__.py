"""Recorded sessions: what describes them, and their reader."""
