"""What the documents show, done as a reader would."""
