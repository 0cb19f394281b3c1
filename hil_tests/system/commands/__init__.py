"""Other commands from end to end."""
