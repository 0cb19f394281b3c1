"""pytest plugin `xethru_hil`, loaded by `hooks`: the same tests on emulated and real radars."""
