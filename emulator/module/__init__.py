"""One X4M300 without I/O: commands, modes, settings, memory, pins, identity."""
