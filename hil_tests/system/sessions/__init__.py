"""What is made of recorded sessions."""
