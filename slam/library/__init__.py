"""The class `Slam`, and what it is made with."""
