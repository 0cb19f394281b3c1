"""Sessions from and to the files of others: rosbags, MATLAB files, wire captures."""
