"""Registrars: the relative motion of a pair of clouds, and the clouds themselves."""
