"""X4M300 serial protocol: wire codes, messages, codec, framing, X4 arithmetic, driver."""
