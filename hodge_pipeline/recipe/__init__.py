"""YAML to a typed recipe: files, overrides, binding, units."""
