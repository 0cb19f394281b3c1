"""Other poses than those that the wheels report: after a slip, and anywhere on a map."""
