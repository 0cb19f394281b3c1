"""xethru_protocol tests."""
