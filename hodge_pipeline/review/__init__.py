"""Review edges by hand: a page on this machine shows them, takes decisions and solves after each."""
