"""The wire of an X4M300 without I/O: messages, codec, framing, X4 arithmetic."""
