"""Mirror of ``emulator.profiles``."""
