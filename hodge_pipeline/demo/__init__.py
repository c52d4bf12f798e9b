"""The demo: a furnished room modelled in code, rendered and written as a TUM sequence."""
