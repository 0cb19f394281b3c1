"""Pages of the documentation: those that are made of the source, and tests of all of them."""
