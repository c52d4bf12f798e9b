"""Which edge of a viewing graph is wrong, with the evidence."""
