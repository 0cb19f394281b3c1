"""Tests of `xethru_protocol.legacy`."""
