"""Review by hand: a page on this machine that shows edges, takes decisions and solves after each."""
