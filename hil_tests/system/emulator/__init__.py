"""The emulator as a process at its ports."""
