"""Sessions: one MCAP file per run, written, read, repaired."""
