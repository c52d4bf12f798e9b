"""The reproduction of the paper: `python -m benchmarks.paper`, which `make paper` calls."""
