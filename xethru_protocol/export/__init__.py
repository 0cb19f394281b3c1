"""The message table as a Kaitai Struct file, a Wireshark dissector and a page of Markdown."""
