"""What any X4M300 does, emulated or real: one body for all.

Run it on your own radars: ``pytest --pyargs hil_tests --radar=/dev/ttyACM0``. Tests assert what the
protocol reference promises of a module, and nothing of what stands in front of it.
"""
