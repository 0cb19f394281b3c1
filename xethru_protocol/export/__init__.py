"""The message table as a Kaitai Struct file and a Wireshark dissector."""
