"""What the commands print, word for word."""
