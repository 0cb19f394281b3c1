"""pytest plugin `xethru_hil`: the same tests on emulated and on real radars.

``hooks`` is what pytest loads. It imports nothing but the standard library; what opens radars is
imported when a test asks for one.
"""
