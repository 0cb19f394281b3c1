"""``xethru view`` and ``xethru vital``: frames as they come, from a module or a recording.

``sources`` gives the frames, ``analysis`` makes `LiveUpdate`s of them, ``terminal_picture`` and
``rerun_view`` show those.
"""
