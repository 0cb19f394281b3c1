"""What `docs/` shows is what happens."""
