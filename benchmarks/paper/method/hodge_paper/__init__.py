"""The paper to the letter, as a plugin: a solver on the surface that Algorithm 1 makes of the viewing graph."""
