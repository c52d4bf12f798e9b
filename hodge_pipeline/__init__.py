"""Globally consistent registration of many scans by Hodge decomposition on the viewing graph."""
