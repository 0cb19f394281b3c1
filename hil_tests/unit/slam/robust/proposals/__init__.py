"""Tests of the robust back end."""
