"""Faults on demand, each of them written down: see `emulator.faults.plan`."""
