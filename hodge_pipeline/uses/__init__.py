"""What the package is used for: run a recipe, refine, register, diagnose, compare, record again."""
