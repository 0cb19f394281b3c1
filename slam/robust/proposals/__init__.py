"""Other motions than those that the wheels report: slips, and carries to anywhere on a map."""
