"""Tests of xethru-hil, and the pytest plugin for tests of your own."""
