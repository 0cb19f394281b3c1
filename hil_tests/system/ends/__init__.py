"""Programs that are ended from outside: signals, terminals that go away, full disks."""
