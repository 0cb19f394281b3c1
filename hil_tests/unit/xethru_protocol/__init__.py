"""Unit tests of xethru_protocol, one file per module."""
