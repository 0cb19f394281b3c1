"""Where emulated modules meet the outside: ptys, TCP, sockets, and the loop that serves them."""
