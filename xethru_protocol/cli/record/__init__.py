"""``xethru record``: what a module sends, written to files as it comes."""
