"""The room as the radars see it: images from the coherent raw frames of moving antennas.

A *range profile* is one frame behind a complex matched filter, its carrier removed
(`range_profiles`). Profiles of one radar are summed along its path with the phase that an echo at
each point would have (`back_projection`). A *patch* is 20 to 30 cm of path of one radar, imaged
together in the frame of its middle, by odometry alone.

Sources: Cumming and Wong, Digital Processing of Synthetic Aperture Radar Data (2005), chapter 2;
Ulander, Hellsten and Stenstroem, IEEE Trans. Aerospace and Electronic Systems 39 (2003) 760, on
back-projection.
"""
