"""The command line: parse first, import heavy libraries after."""
