"""slam tests."""
