"""device tests."""
